"""Single IMU samples that stand out of a calm signal: glitches of the sensor or of its bus, not motion."""

from __future__ import annotations

import numpy as np

from velod.types import F64

ACCEL_SPIKE, GYRO_SPIKE = 25.0, 5.0
"""m/s^2 and rad/s off the line between the neighbours."""
CALM = 0.25
"""The neighbours differ from one another by less than this share of it; vibration makes them differ as well."""


def mend_spikes(values: F64, limit: float, first: int, last: int) -> int:
    """Put samples that stand out by ``limit`` between their neighbours, in place, and return how many.

    ``values``: (n, 3), of which ``first`` <= k < ``last`` are judged.
    A sample without two before it and one after it is left alone.
    """
    mended = 0
    for k in range(max(first, 2), min(last, len(values) - 1)):
        before, after = values[k - 1], values[k + 1]
        mean = 0.5 * (before + after)
        height = float(np.linalg.norm(values[k] - mean))
        if height < limit:
            continue
        unrest = max(float(np.linalg.norm(after - before)), float(np.linalg.norm(before - values[k - 2])))
        if unrest < CALM * height:
            values[k] = mean
            mended += 1
    return mended
