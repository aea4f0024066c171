"""Is the metric scale right? Seen from the velocity's own change against the accelerometer's.

The cameras' velocities are as wrong as the baseline, by a share k; what the IMU integrates is not. In the frame L the
integral s_L differs from the velocity by a constant and by gravity's straight line, and so the batches' own solutions
e = v_L - s_L are

    e = k s_L + a line,

whose lines are taken out over SPAN_S at a time. Where the velocity changes evenly, k cannot be told from gravity: the
sigma then says so. It takes tens of seconds of lively motion to see one per cent. What the IMU's noise adds to s_L
is in e with the other sign, and draws k towards -1: where the velocity hardly swings, that is all there is.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from velod.config import ImuSettings
from velod.types import F64, NS_PER_S

SPAN_S = 2.0
"""Longer, and the gyroscope's noise bends gravity's line; shorter, and there is less to see."""
LONGEST_GAP_S = 0.2
LARGEST_STEP = 50.0
"""m/s between two batches: s_L was counted anew."""
MIN_BATCHES = 20
HELD = 128
"""Spans that count."""
MIN_SPANS = 5


@dataclass(frozen=True, slots=True)
class Scale:
    """The cameras' velocity is 1 + ``error`` times that of the IMU."""

    error: float
    sigma: float


class ScaleCheck:
    """Takes the batches' own solutions, and says what they say of the scale."""

    def __init__(self, imu: ImuSettings) -> None:
        self.imu = imu
        self._open: list[tuple[int, F64, F64]] = []
        # s . e and s . s, less their lines, and what noise alone would make of the latter
        self._spans: deque[tuple[float, float, float]] = deque(maxlen=HELD)

    def add(self, t_ns: int, s_L: F64, e: F64) -> None:
        """A batch's own solution ``e`` (3,) for the error of ``s_L`` (3,), m/s, at its end."""
        if self._open:
            last_ns, last_s, _ = self._open[-1]
            apart = t_ns - last_ns > LONGEST_GAP_S * NS_PER_S or np.abs(s_L - last_s).max() > LARGEST_STEP
            if apart or t_ns <= last_ns:
                self._open.clear()
        self._open.append((t_ns, s_L, e))
        if t_ns - self._open[0][0] >= SPAN_S * NS_PER_S:
            self._close()

    def scale(self) -> Scale | None:
        """What the spans say together, its sigma infinite where that is nothing; None before there are enough."""
        if len(self._spans) < MIN_SPANS:
            return None
        u, d, noise = np.array(self._spans).T
        if d.sum() <= noise.sum():
            return Scale(0.0, math.inf)
        k = float(u.sum() / d.sum())
        # How the spans differ says how sure this is, whatever their errors have in common within.
        freedom = len(u) / (len(u) - 1)
        spread = math.sqrt(freedom * float(((u - k * d) ** 2).sum())) / float(d.sum())
        return Scale(k, math.hypot(spread, float(noise.sum() / d.sum())))

    def _close(self) -> None:
        if len(self._open) >= MIN_BATCHES:
            t = np.array([t_ns - self._open[0][0] for t_ns, _, _ in self._open]) / NS_PER_S
            s, e = (_less_line(t, np.array([row[i] for row in self._open])) for i in (1, 2))
            self._spans.append((float((s * e).sum()), float((s * s).sum()), len(t) * noise_of_span(self.imu)))
        self._open.clear()


def noise_of_span(imu: ImuSettings) -> float:
    """Mean square of s_L, m^2/s^2 and of all axes, that the IMU's noise makes over SPAN_S, less its line.

    Of a random walk of unit density the line leaves T/15, of its integral T^3/420. The accelerometer's noise makes
    the former; a walking bias, and the tilt that the gyroscope's noise gives to gravity, the latter.
    """
    walk = 3.0 * imu.accel_noise**2
    integrated = 3.0 * imu.accel_bias_walk**2 + 2.0 * (imu.gravity * imu.gyro_noise) ** 2
    return walk * SPAN_S / 15.0 + integrated * SPAN_S**3 / 420.0


def _less_line(t: F64, x: F64) -> F64:
    """Rows x (n, 3) less their straight line in t (n,)."""
    tc = t - t.mean()
    xc = x - x.mean(axis=0)
    return np.asarray(xc - np.outer(tc, tc @ xc) / (tc @ tc))
