"""Single IMU samples that stand out of a calm signal: glitches of the sensor or of its bus, not motion."""

from __future__ import annotations

import math

from numba import njit

from velod.types import F64

ACCEL_SPIKE, GYRO_SPIKE = 25.0, 5.0
"""m/s^2 and rad/s off the line between the neighbours."""
CALM = 0.25
"""The neighbours differ from one another by less than this share of it; vibration makes them differ as well."""


@njit(cache=True, nogil=True)
def mend_spikes(values: F64, limit: float, first: int, last: int) -> int:
    """Put samples that stand out by ``limit`` between their neighbours, in place, and return how many.

    ``values``: (n, 3), of which ``first`` <= k < ``last`` are judged.
    A sample without two before it and one after it is left alone.
    """
    mended = 0
    for k in range(max(first, 2), min(last, len(values) - 1)):
        height = math.sqrt(
            (values[k, 0] - 0.5 * (values[k - 1, 0] + values[k + 1, 0])) ** 2
            + (values[k, 1] - 0.5 * (values[k - 1, 1] + values[k + 1, 1])) ** 2
            + (values[k, 2] - 0.5 * (values[k - 1, 2] + values[k + 1, 2])) ** 2
        )
        if height < limit:
            continue
        unrest = max(_distance(values, k + 1, k - 1), _distance(values, k - 1, k - 2))
        if unrest < CALM * height:
            for i in range(3):
                values[k, i] = 0.5 * (values[k - 1, i] + values[k + 1, i])
            mended += 1
    return mended


@njit(cache=True, nogil=True)
def _distance(values: F64, a: int, b: int) -> float:
    """Between two rows."""
    x, y, z = values[a, 0] - values[b, 0], values[a, 1] - values[b, 1], values[a, 2] - values[b, 2]
    return math.sqrt(x * x + y * y + z * z)
