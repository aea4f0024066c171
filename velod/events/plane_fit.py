"""Plane through the 5x5 same-polarity neighbours of an event on the surface of active events (Eq. 5).

The surface is locally t(x, y) = gx (x - x0) + gy (y - y0) + t0, where (gx, gy) is the SAE's gradient
``grad_T`` in s/px (Eq. 6 reads the normal flow off it) and t0 the time of the plane at the centre pixel.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from velod.types import F64, PATCH

SIZE = PATCH * PATCH
HALF = PATCH // 2
MIN_DETERMINANT = 1e-3
"""A fit is near-singular when the determinant of the moments is below this share of the variances' product."""

PlaneFit = tuple[int, float, float, float, float, float, float, float]
"""(n, gx, gy, t0, rms, qxx, qxy, qyy): see ``fit_plane``."""


DX, DY = (offset.ravel().astype(np.float64) for offset in np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1][::-1])
"""Of the neighbours from the centre, px, row-major."""
BIT = 1 << np.arange(SIZE)
ALL = int(BIT.sum())
"""Sets of neighbours are the bits of a number."""

ANY_ORDER = {"reassoc", "contract", "nsz"}
"""Floating-point freedom of the kernels here: in the order that is written no sum could be vectorised."""


@njit(fastmath=ANY_ORDER, cache=True, nogil=True, error_model="numpy")
def _moments(kept: np.int64) -> tuple[float, float, float, float, float, float]:
    """Sums of 1, dx, dy, dx^2, dx dy and dy^2 over the neighbours ``kept``."""
    if kept == ALL:
        return 25.0, 0.0, 0.0, 50.0, 0.0, 50.0
    n = x = y = xx = xy = yy = 0.0
    for i in range(SIZE):
        k = 1.0 if kept & BIT[i] else 0.0
        n += k
        x += k * DX[i]
        y += k * DY[i]
        xx += k * DX[i] * DX[i]
        xy += k * DX[i] * DY[i]
        yy += k * DY[i] * DY[i]
    return n, x, y, xx, xy, yy


@njit(fastmath=ANY_ORDER, cache=True, nogil=True, error_model="numpy")
def fit_plane(age: F64, reject_px: float, rejections: int, min_neighbours: int) -> PlaneFit:
    """Least-squares plane t = gx dx + gy dy + t0 through the neighbours, outliers rejected.

    ``age``: (25,) float64, row-major 5x5 patch, seconds before the batch's end; <= 0 marks a missing neighbour.
    The time fitted is t = -age and dx, dy = -2..2 px count from the centre. Each of up to ``rejections`` rounds
    drops the neighbours whose residual exceeds ``reject_px`` times the slope's norm, then fits again.

    Returns (n, gx, gy, t0, rms, qxx, qxy, qyy): neighbours left, slope in s/px, time of the plane at the centre
    in s (<= 0: before the batch's end), rms residual in s, and the slope's cofactor matrix Q in 1/px^2, so that
    its covariance is sigma_t^2 Q. n = 0 (and zeros) where fewer than ``min_neighbours`` are left or the fit is
    near-singular.
    """
    missing = np.int64(0)
    for i in range(SIZE):
        missing |= np.int64(0) if age[i] > 0.0 else BIT[i]
    kept = ALL & ~missing
    # Times are taken from the centre's, so that no digits are lost when centring the moments.
    t_ref = -age[SIZE // 2]
    for round_ in range(rejections + 1):
        n, x, y, xx, xy, yy = _moments(kept)
        t = xt = yt = 0.0
        for i in range(SIZE):
            kt = -age[i] - t_ref if kept & BIT[i] else 0.0
            t += kt
            xt += DX[i] * kt
            yt += DY[i] * kt
        if n < min_neighbours or n < 3:
            break
        per_n = 1.0 / n
        mx, my, mt = x * per_n, y * per_n, t * per_n
        sxx, sxy, syy = xx - x * mx, xy - x * my, yy - y * my
        sxt, syt = xt - x * mt, yt - y * mt
        det = sxx * syy - sxy * sxy
        if det <= MIN_DETERMINANT * sxx * syy:
            break
        qxx, qxy, qyy = syy / det, -sxy / det, sxx / det
        gx = qxx * sxt + qxy * syt
        gy = qxy * sxt + qyy * syt
        t0 = mt - gx * mx - gy * my + t_ref
        limit = reject_px * math.sqrt(gx * gx + gy * gy)
        rss = 0.0
        outliers = np.int64(0)
        for i in range(SIZE):
            r = -age[i] - t0 - gx * DX[i] - gy * DY[i]
            rss += r * r if kept & BIT[i] else 0.0
            outliers |= BIT[i] if abs(r) > limit else np.int64(0)
        outliers &= kept
        if outliers == 0 or round_ == rejections:
            return int(n), gx, gy, t0, math.sqrt(rss * per_n), qxx, qxy, qyy
        kept &= ~outliers
    return 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
