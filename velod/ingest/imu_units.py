"""Whether the IMU speaks in m/s^2 and rad/s, as far as its values tell."""

from __future__ import annotations

import math

from numba import njit

from velod.types import F64, I64, NS_PER_S

PERIOD_NS = NS_PER_S
LEAST_M_S2 = 2.5
"""Less than this over a second is free fall, or an accelerometer in g."""
MOST_RAD_S = 40.0
"""2000 degrees a second, where most gyroscopes end, are 35 rad/s."""


class ImuUnits:
    """``alarm`` says what is doubted of the last whole second; "" if nothing."""

    def __init__(self) -> None:
        self.alarm = ""
        self._begin()

    def _begin(self) -> None:
        self._since_ns, self._n, self._accel, self._gyro = 0, 0, 0.0, 0.0

    def add(self, t_ns: I64, accel: F64, gyro: F64) -> None:
        """Good samples: times (n,), m/s^2 (n, 3), rad/s (n, 3)."""
        if not len(t_ns):
            return
        if self._n == 0:
            self._since_ns = int(t_ns[0])
        self._n += len(t_ns)
        self._accel += _sum_of_norms(accel)
        self._gyro += _sum_of_norms(gyro)
        if int(t_ns[-1]) - self._since_ns >= PERIOD_NS:
            self.alarm = _doubt(self._accel / self._n, self._gyro / self._n)
            self._begin()


def _doubt(accel: float, gyro: float) -> str:
    if accel < LEAST_M_S2:
        return f"the accelerometer reads {accel:.2f} m/s^2 over a second: is it in g?"
    if gyro > MOST_RAD_S:
        return f"the gyroscope reads {gyro:.0f} rad/s over a second: is it in degrees?"
    return ""


@njit(cache=True, nogil=True)
def _sum_of_norms(rows: F64) -> float:
    total = 0.0
    for i in range(len(rows)):
        total += math.sqrt(rows[i, 0] ** 2 + rows[i, 1] ** 2 + rows[i, 2] ** 2)
    return total
