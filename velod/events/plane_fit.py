"""Plane through the same-polarity neighbours of an event on the surface of active events (Eq. 5).

The surface is locally t(x, y) = gx (x - x0) + gy (y - y0) + t0, where (gx, gy) is the SAE's gradient
``grad_T`` in s/px (Eq. 6 reads the normal flow off it) and t0 the time of the plane at the centre pixel.

A plane is found in the paper's 5x5 neighbours and then widened to those of the 7x7 that lie on it as well: the
slope's variance falls to a quarter, and a neighbour on another edge does no harm, since the plane is known by then.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from velod.types import F64, PATCH, WIDE

SIZE = PATCH * PATCH
HALF = PATCH // 2
WIDE_SIZE = WIDE * WIDE
REACH = WIDE // 2
RING_ROW, RING_COLUMN = np.argwhere(
    np.pad(np.zeros((PATCH, PATCH)), (WIDE - PATCH) // 2, constant_values=1.0)
).T.copy()
"""Where in the 7x7 the neighbours around the 5x5 are, (24,) each, row-major."""
RING_AT = RING_ROW * WIDE + RING_COLUMN
INNER_AT = np.setdiff1d(np.arange(WIDE_SIZE), RING_AT)
"""Where in the flat 7x7 the neighbours around the 5x5 are, (24,), and the 5x5, (25,)."""
MIN_DETERMINANT = 1e-3
"""A fit is near-singular when the determinant of the moments is below this share of the variances' product."""

USUAL_RMS_PX, USUAL_WEIGHT = 0.15, 10.0
"""The residual that fits usually have, px, and as how many neighbours it counts: a residual far below it is luck."""

NOISE_REACH = 2.5
"""So many standard deviations of its time stamp may a neighbour be off beside the limit in px."""
NOISE_RMS2 = 1.3
"""So many variances of the time stamps may a fit's mean square residual hold beside the gate in px: that of 25
neighbours scatters by 0.3."""

PlaneFit = tuple[int, float, float, float, float, float, float, float]
"""(n, gx, gy, t0, rms, qxx, qxy, qyy): see ``fit_plane``."""


DX, DY = (offset.ravel().astype(np.float64) for offset in np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1][::-1])
"""Of the neighbours from the centre, px, row-major."""
WIDE_DX, WIDE_DY = (
    offset.ravel().astype(np.float64) for offset in np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1][::-1]
)
"""Likewise of the 7x7."""
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


@njit(cache=True, nogil=True)
def rms_px(rms: float, slope2: float, time_noise_s: float) -> float:
    """Residual of a plane in px, less what time stamps with that error account for; inf without a slope.

    A gate on the residual as it is would let pass, of fast edges, those fits whose slope came out too large.
    """
    left = max(rms * rms - NOISE_RMS2 * time_noise_s * time_noise_s, 0.0)
    return math.sqrt(left / slope2) if slope2 > 0.0 else math.inf


@njit(cache=True, nogil=True)
def _reach_s(limit_px: float, slope2: float, time_noise_s: float) -> float:
    """How far from a plane a neighbour may be, s."""
    return math.sqrt(limit_px * limit_px * slope2 + NOISE_REACH * NOISE_REACH * time_noise_s * time_noise_s)


@njit(fastmath=ANY_ORDER, cache=True, nogil=True, error_model="numpy")
def fit_plane(
    age: F64, reject_px: float, rejections: int, min_neighbours: int, time_noise_s: float = 0.0
) -> PlaneFit:
    """Least-squares plane t = gx dx + gy dy + t0 through the neighbours, outliers rejected.

    ``age``: (25,) float64, row-major 5x5 patch, seconds before the batch's end; <= 0 marks a missing neighbour.
    The time fitted is t = -age and dx, dy = -2..2 px count from the centre. Each of up to ``rejections`` rounds
    drops the neighbours whose residual exceeds ``reject_px`` times the slope's norm and, in quadrature, what time
    stamps with an error of ``time_noise_s`` account for, then fits again.

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
        limit = _reach_s(reject_px, gx * gx + gy * gy, time_noise_s)
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


@njit(fastmath=ANY_ORDER, cache=True, nogil=True, error_model="numpy")
def widen_plane(
    fit: PlaneFit, age: F64, reject_px: float, max_rms_px: float, time_noise_s: float = 0.0
) -> tuple[PlaneFit, float, float]:
    """The plane through those of the 7x7 neighbours that lie within ``reject_px`` of ``fit``, or in its time noise.

    ``age``: (49,) float64, row-major 7x7 patch, as that of ``fit_plane``; ``fit`` has been found in its middle.
    Returns what ``fit_plane`` does; by how much the residuals bend along the slope, s/px^2 (>= 0, half the second
    derivative; as if no neighbour were missing); and the rms residual from which errors of the slope follow, s: where
    no neighbour is missing without bends, which are even and leave the slope alone. ``fit`` itself, 0 and its rms
    where the new plane is near-singular or its ``rms_px`` not below ``max_rms_px``.
    """
    _, gx, gy, t0, fit_rms, _, _, _ = fit
    limit = _reach_s(reject_px, gx * gx + gy * gy, time_noise_s)
    # Moments of the residuals: what the slope and the time of the new plane differ by follows from them.
    n = x = y = xx = xy = yy = 0.0
    r = xr = yr = rr = xxr = xyr = yyr = 0.0
    for i in range(WIDE_SIZE):
        dx, dy = WIDE_DX[i], WIDE_DY[i]
        residual = -age[i] - t0 - gx * dx - gy * dy
        k = 1.0 if (age[i] > 0.0) & (abs(residual) <= limit) else 0.0
        n += k
        x += k * dx
        y += k * dy
        xx += k * dx * dx
        xy += k * dx * dy
        yy += k * dy * dy
        kr = k * residual
        r += kr
        xr += dx * kr
        yr += dy * kr
        rr += kr * residual
        xxr += dx * dx * kr
        xyr += dx * dy * kr
        yyr += dy * dy * kr
    if n < 4:
        return fit, 0.0, fit_rms
    mx, my, mr = x / n, y / n, r / n
    sxx, sxy, syy = xx - x * mx, xy - x * my, yy - y * my
    sxr, syr = xr - x * mr, yr - y * mr
    det = sxx * syy - sxy * sxy
    if det <= MIN_DETERMINANT * sxx * syy:
        return fit, 0.0, fit_rms
    hx = (syy * sxr - sxy * syr) / det
    hy = (sxx * syr - sxy * sxr) / det
    gx += hx
    gy += hy
    rms = math.sqrt(max(rr - r * mr - hx * sxr - hy * syr, 0.0) / n)
    slope2 = gx * gx + gy * gy
    if not rms_px(rms, slope2, time_noise_s) < max_rms_px:
        return fit, 0.0, fit_rms
    # On the full grid x^2, x y and y^2 are orthogonal to the plane (but for their means) and to each other.
    a, b, c = (xxr - 4.0 * r) / 588.0, (yyr - 4.0 * r) / 588.0, xyr / 784.0
    bend = abs(gx * gx * a + gy * gy * b + gx * gy * c) / slope2
    slope_rms = rms
    if n == WIDE_SIZE:
        odd = max(n * rms * rms - 588.0 * (a * a + b * b) - 784.0 * c * c, 0.0)
        slope_rms = math.sqrt(odd / n * (n - 3) / (n - 6))  # the bends are three parameters more
    widened = (int(n), gx, gy, t0 + mr - hx * mx - hy * my, rms, syy / det, -sxy / det, sxx / det)
    return widened, bend, slope_rms


@njit(cache=True, nogil=True)
def honest_rms(n: int, rms: float, slope: float, time_noise_s: float = 0.0) -> float:
    """Standard deviation of a neighbour's time about the true plane, s, from a fit's ``n``, ``rms`` and slope's norm.

    The mean of what the residuals say, less the three parameters fitted to them, and of what is usual.
    """
    usual2 = USUAL_RMS_PX * USUAL_RMS_PX * slope * slope + time_noise_s * time_noise_s
    return math.sqrt((n * rms * rms + USUAL_WEIGHT * usual2) / (n - 3 + USUAL_WEIGHT))
