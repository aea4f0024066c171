"""Normal flow from the neighbourhoods of a whole batch, in one compiled call."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from velod.events.plane_fit import (
    INNER_AT,
    RING_AT,
    SIZE,
    WIDE_SIZE,
    PlaneFit,
    fit_plane,
    honest_rms,
    rms_px,
    widen_plane,
)
from velod.geometry.cholesky import backward, factorise, forward
from velod.types import F32, F64, I64, RING, U16, U32

REFUSALS = ("unfit", "rms", "speed", "unrectified")
"""Why an event gets no flow: no plane (too few neighbours or singular), rms gate, speed gate, outside the lens."""

_UNFIT, _RMS, _SPEED, _UNRECTIFIED = range(4)

INFLATION = 1.2
"""Scatter of flows, against the truth, over what white residuals would make of it: neighbours share errors."""
BEND_PX = 1.0
"""Where the surface bends along n, sigma lets in the change of slope over half of this: what is seen of a bend tells
of what is not seen of it, which turns the plane."""

USUAL_ACCELERATION_PX_S2 = 5000.0
"""How fast an edge may well speed up or slow down: that of 20 rad/s^2 in 250 px. A fast edge has no time for it."""

MOTION_UNIT_PX = 100.0
"""Distances from the flows' mean position are in this unit in the affine image motion."""


@njit(cache=True, nogil=True)
def fit_flows(
    x: U16,
    y: U16,
    patch: U32,
    ring: U32,
    xy: F32,
    covector: F32,
    reject_px: float,
    rejections: int,
    min_neighbours: int,
    max_rms_px: float,
    max_speed_px_s: float,
    benosman: bool,
    time_noise_s: float,
    index: U16,
    flow: F32,
    refused: I64,
) -> int:
    """Flows of n events at sensor pixels ``x``, ``y`` (n,) with ``patch`` (n, 25) ages in ns, 0 = none.

    ``ring`` holds the ages around them, (n, 24), or has no rows: then the planes stay on their 5x5 neighbours. Their
    error is ``time_noise_s`` beside what the edges' shapes do.
    ``xy`` (h, w, 2) and ``covector`` (h, w, 2, 2) take sensor pixels and SAE gradients to the rectified image.
    Writes for each of the m flows its position in the batch to ``index`` and (x, y, nx, ny, speed, sigma) in
    rectified px and px/s to ``flow`` (n, 6); adds the others to ``refused`` by cause. Returns m.
    """
    age, wide = np.empty(SIZE, np.float64), np.empty(WIDE_SIZE, np.float64)
    turn = np.empty(x.size, np.float64)
    m = 0
    for i in range(x.size):
        for j in range(SIZE):
            age[j] = patch[i, j] * 1e-9
        fit = fit_plane(age, reject_px, rejections, min_neighbours, time_noise_s)
        if fit[0] == 0:
            refused[_UNFIT] += 1
            continue
        bend, slope_rms, too_steep = 0.0, fit[4], 0.0
        if len(ring) > 0:
            _put_around(age, ring, i, wide)
            fit, bend, slope_rms = widen_plane(fit, wide, reject_px, max_rms_px, time_noise_s)
            too_steep = _too_steep(fit, bend, slope_rms, time_noise_s)
        _, gx, gy, _, rms, _, _, _ = fit
        slope = math.sqrt(gx * gx + gy * gy)
        if not rms_px(rms, slope * slope, time_noise_s) < max_rms_px:
            refused[_RMS] += 1
            continue
        r, c = y[i], x[i]
        # grad_T is a covector: it transforms by the inverse transpose of the undistortion's Jacobian.
        M = (covector[r, c, 0, 0], covector[r, c, 0, 1], covector[r, c, 1, 0], covector[r, c, 1, 1])
        tx, ty = M[0] * gx + M[1] * gy, M[2] * gx + M[3] * gy
        grad_T = math.sqrt(tx * tx + ty * ty)
        if not grad_T < math.inf:
            refused[_UNRECTIFIED] += 1
            continue
        if grad_T * max_speed_px_s < 1.0:
            refused[_SPEED] += 1
            continue
        # Eq. 6: the normal flow is grad_T / |grad_T|^2.
        nx, ny, speed = tx / grad_T, ty / grad_T, 1.0 / grad_T
        along, turn[m] = _shares(fit, slope, bend, slope_rms, time_noise_s, M, nx, ny, speed)
        speed *= 1.0 + too_steep
        if benosman:
            nx, ny, speed = _by_components(tx, ty)
        index[m] = i
        flow[m, 0], flow[m, 1] = xy[r, c, 0], xy[r, c, 1]
        flow[m, 2], flow[m, 3], flow[m, 4], flow[m, 5] = nx, ny, speed, along * speed
        m += 1
    if m > 0:
        _let_in_motion_along_edges(flow[:m], turn[:m])
    return m


@njit(cache=True, nogil=True)
def _put_around(age: F64, ring: U32, i: int, wide: F64) -> None:
    """``wide`` (49,), s: the 7x7 of ``age`` (25,), s, with row ``i`` of ``ring`` (n, 24), ns, around it."""
    for j in range(SIZE):
        wide[INNER_AT[j]] = age[j]
    for j in range(RING):
        wide[RING_AT[j]] = ring[i, j] * 1e-9


@njit(cache=True, nogil=True)
def _by_components(tx: float, ty: float) -> tuple[float, float, float]:
    """(nx, ny, speed) of the per-component reciprocal (Benosman 2014), the baseline of Table II."""
    bx = 1.0 / tx if tx != 0.0 else 0.0
    by = 1.0 / ty if ty != 0.0 else 0.0
    speed = math.hypot(bx, by)
    return bx / speed, by / speed, speed


@njit(cache=True, nogil=True)
def _too_steep(fit: PlaneFit, bend: float, slope_rms: float, time_noise_s: float) -> float:
    """By what share the mean slope over the 7x7 is above that at the event, where the edge speeds up or slows down.

    Where speed goes with the way, v + k s, an edge passes s at t = s/v + b s^2 + (4/3) v b^2 s^3 with the ``bend`` b
    = -k / (2 v^2). The square is even and leaves the slope alone, the cube adds (4/3) v b^2 <s^4> / <s^2>. (Where it
    goes with time the factor is 2; nobody knows which.) Of a bend only that counts which is neither likely noise nor
    more than an edge may well speed up.
    """
    n, gx, gy, _, _, _, _, _ = fit
    if bend == 0.0:  # not told
        return 0.0
    slope = math.sqrt(gx * gx + gy * gy)
    diagonal = (gx * gy / (slope * slope)) ** 2
    # The bend, in 1/px, squared; by noise, as x^2 and y^2 have 588 px^4 on the full grid, x y has 784; and as usual.
    bend2 = (bend / slope) ** 2
    noise2 = (honest_rms(n, slope_rms, slope, time_noise_s) / slope) ** 2 * (
        (1.0 - 2.0 * diagonal) / 588.0 + diagonal / 784.0
    )
    usual2 = (0.5 * USUAL_ACCELERATION_PX_S2 * slope * slope) ** 2
    # <s^4> / <s^2> is 7 px^2 along an axis, 9.5 along a diagonal.
    return 4.0 / 3.0 * usual2 / (usual2 + noise2 + bend2) * (bend2 - noise2) * (7.0 + 10.0 * diagonal)


@njit(cache=True, nogil=True)
def _shares(
    fit: PlaneFit,
    slope: float,
    bend: float,
    slope_rms: float,
    time_noise_s: float,
    M: tuple[float, float, float, float],
    nx: float,
    ny: float,
    speed: float,
) -> tuple[float, float]:
    """Standard deviations of the slope along n and across it, as shares of it: errors of speed and direction (rad).

    ``M``, the rows of a 2x2 matrix, takes the sensor's gradients to the rectified image, where n and ``speed`` are.
    """
    n, _, _, _, _, qxx, qxy, qyy = fit
    a, b, d, e = M
    sigma_t = INFLATION * honest_rms(n, slope_rms, slope, time_noise_s)
    along = math.hypot(
        speed * sigma_t * _deviation(qxx, qxy, qyy, a * nx + d * ny, b * nx + e * ny),
        BEND_PX * bend / slope,
    )
    return along, speed * sigma_t * _deviation(qxx, qxy, qyy, d * nx - a * ny, e * nx - b * ny)


@njit(cache=True, nogil=True)
def _let_in_motion_along_edges(flow: F32, turn: F64) -> None:
    """Add to the sigmas what an error ``turn`` (m,), rad, of n lets in of the motion along the edge.

    A flow does not know that motion, but the batch does: u(x, y) = a + b x + c y, fitted to n . u = speed. What the
    fit leaves counts as unknown, and for its six parameters as much as six flows. The unit diagonal holds down what
    the edges do not determine.
    """
    m = len(flow)
    x = np.ascontiguousarray(flow[:, 0]).astype(np.float64)
    y = np.ascontiguousarray(flow[:, 1]).astype(np.float64)
    x, y = (x - x.mean()) / MOTION_UNIT_PX, (y - y.mean()) / MOTION_UNIT_PX
    row, H, u = np.empty(6), np.eye(6), np.zeros(6)
    for i in range(m):
        nx, ny = np.float64(flow[i, 2]), np.float64(flow[i, 3])
        row[:] = nx, ny, nx * x[i], ny * x[i], nx * y[i], ny * y[i]
        for j in range(6):
            u[j] += row[j] * flow[i, 4]
            for k in range(j + 1):
                H[j, k] += row[j] * row[k]
    factorise(H)
    forward(H, u)
    backward(H, u)
    left2 = 6.0 * np.mean(flow[:, 4].astype(np.float64) ** 2) / m
    for i in range(m):
        ux, uy = u[0] + u[2] * x[i] + u[4] * y[i], u[1] + u[3] * x[i] + u[5] * y[i]
        left2 += (flow[i, 4] - flow[i, 2] * ux - flow[i, 3] * uy) ** 2 / m
    for i in range(m):
        ux, uy = u[0] + u[2] * x[i] + u[4] * y[i], u[1] + u[3] * x[i] + u[5] * y[i]
        along_edge2 = (flow[i, 2] * uy - flow[i, 3] * ux) ** 2 + left2
        flow[i, 5] = math.sqrt(np.float64(flow[i, 5]) ** 2 + along_edge2 * turn[i] ** 2)


@njit(cache=True, nogil=True, inline="always")
def _deviation(qxx: float, qxy: float, qyy: float, ux: float, uy: float) -> float:
    """Root of u^T Q u."""
    return math.sqrt(qxx * ux * ux + 2.0 * qxy * ux * uy + qyy * uy * uy)
