"""Normal flow from the neighbourhoods of a whole batch, in one compiled call."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from velod.events.plane_fit import SIZE, fit_plane
from velod.types import F32, I64, U16, U32

REFUSALS = ("unfit", "rms", "speed", "unrectified")
"""Why an event gets no flow: no plane (too few neighbours or singular), rms gate, speed gate, outside the lens."""

_UNFIT, _RMS, _SPEED, _UNRECTIFIED = range(4)

FIT_INFLATION = 1.1
SHARE_FLOOR = 0.006
"""Sigma's share of the speed is FIT_INFLATION times the fit's own and this floor, which no residual shows."""

NORMAL_TO_FULL = 1.25
"""Full image motion over the mean normal flow of a batch (pi/2 for edges of all directions, 1 for one direction)."""


@njit(cache=True, nogil=True)
def fit_flows(
    x: U16,
    y: U16,
    patch: U32,
    xy: F32,
    covector: F32,
    reject_px: float,
    rejections: int,
    min_neighbours: int,
    max_rms_px: float,
    max_speed_px_s: float,
    benosman: bool,
    index: U16,
    flow: F32,
    refused: I64,
) -> int:
    """Flows of n events at sensor pixels ``x``, ``y`` (n,) with ``patch`` (n, 25) ages in ns, 0 = none.

    ``xy`` (h, w, 2) and ``covector`` (h, w, 2, 2) take sensor pixels and SAE gradients to the rectified image.
    Writes for each of the m flows its position in the batch to ``index`` and (x, y, nx, ny, speed, sigma) in
    rectified px and px/s to ``flow`` (n, 6); adds the others to ``refused`` by cause. Returns m.
    """
    age = np.empty(SIZE, np.float64)
    m = 0
    total = 0.0
    for i in range(x.size):
        for j in range(SIZE):
            age[j] = patch[i, j] * 1e-9
        n, gx, gy, _, rms, qxx, qxy, qyy = fit_plane(age, reject_px, rejections, min_neighbours)
        if n == 0:
            refused[_UNFIT] += 1
            continue
        if not rms < max_rms_px * math.hypot(gx, gy):
            refused[_RMS] += 1
            continue
        r, c = y[i], x[i]
        a, b = float(covector[r, c, 0, 0]), float(covector[r, c, 0, 1])
        d, e = float(covector[r, c, 1, 0]), float(covector[r, c, 1, 1])
        # grad_T is a covector: it transforms by the inverse transpose of the undistortion's Jacobian.
        tx = a * gx + b * gy
        ty = d * gx + e * gy
        grad_T = math.hypot(tx, ty)
        if not grad_T < math.inf:
            refused[_UNRECTIFIED] += 1
            continue
        if grad_T * max_speed_px_s < 1.0:
            refused[_SPEED] += 1
            continue
        # Eq. 6: the normal flow is grad_T / |grad_T|^2.
        nx, ny, speed = tx / grad_T, ty / grad_T, 1.0 / grad_T
        # Slope along n, seen from the sensor's axes, and its variance from the fit's covariance.
        ux, uy = a * nx + d * ny, b * nx + e * ny
        sigma_t = rms * math.sqrt(n / max(n - 3, 1))
        sigma_grad = sigma_t * math.sqrt(qxx * ux * ux + 2.0 * qxy * ux * uy + qyy * uy * uy)
        share = FIT_INFLATION * math.hypot(speed * sigma_grad, SHARE_FLOOR)
        if benosman:
            # Per-component reciprocal (Benosman 2014), the baseline of Table II.
            bx = 1.0 / tx if tx != 0.0 else 0.0
            by = 1.0 / ty if ty != 0.0 else 0.0
            speed = math.hypot(bx, by)
            nx, ny = bx / speed, by / speed
        index[m] = i
        flow[m, 0] = xy[r, c, 0]
        flow[m, 1] = xy[r, c, 1]
        flow[m, 2] = nx
        flow[m, 3] = ny
        flow[m, 4] = speed
        flow[m, 5] = share
        total += speed
        m += 1
    # An error in n lets in the motion along the edge, which a flow does not know but the batch does.
    for i in range(m):
        flow[i, 5] *= max(float(flow[i, 4]), NORMAL_TO_FULL * total / m)
    return m
