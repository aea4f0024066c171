"""Plane through the 5x5 same-polarity neighbours of an event on the surface of active events (Eq. 5).

The surface is locally t(x, y) = gx (x - x0) + gy (y - y0) + t0, where (gx, gy) is the SAE's gradient
``grad_T`` in s/px (Eq. 6 reads the normal flow off it) and t0 the time of the plane at the centre pixel.
"""

from __future__ import annotations

import math

from numba import njit

from velod.types import F64, PATCH

SIZE = PATCH * PATCH
HALF = PATCH // 2
MIN_DETERMINANT = 1e-3
"""A fit is near-singular when the determinant of the moments is below this share of the variances' product."""

PlaneFit = tuple[int, float, float, float, float, float, float, float]
"""(n, gx, gy, t0, rms, qxx, qxy, qyy): see ``fit_plane``."""


@njit(cache=True, nogil=True)
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
    kept = 0
    for i in range(SIZE):
        kept |= int(age[i] > 0.0) << i
    t_ref = -age[SIZE // 2]
    for round_ in range(rejections + 1):
        # One branchless pass; t is taken from the centre's, so that no digits are lost when centring the moments.
        i = n = x = y = xx = xy = yy = 0
        t = xt = yt = 0.0
        for dy in range(-HALF, HALF + 1):
            for dx in range(-HALF, HALF + 1):
                k = kept >> i & 1
                n += k
                x += k * dx
                y += k * dy
                xx += k * dx * dx
                xy += k * dx * dy
                yy += k * dy * dy
                kt = k * (-age[i] - t_ref)
                t += kt
                xt += dx * kt
                yt += dy * kt
                i += 1
        if n < min_neighbours or n < 3:
            break
        mx, my, mt = x / n, y / n, t / n
        sxx, sxy, syy = xx - x * mx, xy - x * my, yy - y * my
        sxt, syt = xt - x * mt, yt - y * mt
        det = sxx * syy - sxy * sxy
        if det <= MIN_DETERMINANT * sxx * syy:
            break
        gx = (syy * sxt - sxy * syt) / det
        gy = (sxx * syt - sxy * sxt) / det
        t0 = mt - gx * mx - gy * my + t_ref
        limit = reject_px * math.sqrt(gx * gx + gy * gy)
        rss = 0.0
        i = outliers = 0
        for dy in range(-HALF, HALF + 1):
            for dx in range(-HALF, HALF + 1):
                k = kept >> i & 1
                r = -age[i] - t0 - gx * dx - gy * dy
                rss += k * r * r
                outliers |= int(abs(r) > limit) << i
                i += 1
        outliers &= kept
        if outliers == 0 or round_ == rejections:
            return n, gx, gy, t0, math.sqrt(rss / n), syy / det, -sxy / det, sxx / det
        kept &= ~outliers
    return 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
