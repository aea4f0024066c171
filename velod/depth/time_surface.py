"""Decayed time surfaces of block matching (Sec. III-C): exp(-age / tau) of the last event, on the rectified grid."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from velod.events.columns import readonly
from velod.types import F32, NS_PER_S, U16


def decay_table(unit_ns: int, tau_s: float) -> F32:
    """(65536,) values of the time surface by age in steps of ``unit_ns``; 0 at age 0, which means "no event"."""
    age_s = np.arange(65536, dtype=np.float64) * (unit_ns / NS_PER_S)
    table = np.exp(-age_s / tau_s).astype(np.float32)
    table[0] = 0.0
    return table


class TimeSurface:
    """Time surfaces of one camera on the rectified grid, mirrored left to right on demand.

    ``remap`` holds the sensor position (x, y) of each rectified pixel, NaN where there is none; None: the sensor is
    the rectified grid.
    """

    def __init__(self, remap: tuple[F32, F32] | None, *, mirrored: bool = False) -> None:
        self._mirrored = mirrored
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        if remap is not None:
            # Far outside, so that cv2.remap writes the border's value, 0.
            x, y = (np.where(np.isnan(m), np.float32(-1e4), m) for m in remap)
            if mirrored:
                x, y = x[:, ::-1], y[:, ::-1]
            self._maps = cv2.convertMaps(np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.CV_16SC2)

    def render(self, ages: U16, table: F32) -> F32:
        """(height, width) float32 in 0..1 of ages (h, w) on the sensor grid, with ``table`` from ``decay_table``."""
        surface = np.empty(ages.shape, np.float32)
        # The maps mirror by themselves.
        _decay(readonly(ages, np.uint16), table, self._mirrored and self._maps is None, surface)
        return surface if self._maps is None else np.asarray(cv2.remap(surface, *self._maps, cv2.INTER_LINEAR))


@njit(cache=True, nogil=True)
def _decay(ages: U16, table: F32, mirrored: bool, out: F32) -> None:
    """out = table[ages], each row backwards if ``mirrored``."""
    h, w = ages.shape
    for r in range(h):
        row, decayed = ages[r], out[r]
        if mirrored:
            for c in range(w):
                decayed[w - 1 - c] = table[row[c]]
        else:
            for c in range(w):
                decayed[c] = table[row[c]]
