"""Plane-coincidence refinement: the sub-pixel disparity at which an edge reaches both cameras at the same time.

The edge's passage is a plane on the surface of active events of each camera. At the coarse match the plane of the
right camera is solved along the rectified row for the place where its time equals that of the left plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from velod.events.columns import readonly
from velod.events.plane_fit import (
    INNER_AT,
    REACH,
    SIZE,
    WIDE_SIZE,
    PlaneFit,
    fit_plane,
    honest_rms,
    rms_px,
    widen_plane,
)
from velod.geometry.rectify import Rectification
from velod.types import F32, F64, I64, NS_PER_S, U8, U16, WIDE

# Plane fits as for the flow (docs/method.md).
_REJECT_PX = 1.0
_REJECTIONS = 2
_MIN_NEIGHBOURS = 20
# Fewer on the right, whose patch is placed by a match that may be a pixel off: its slope only turns a time
# difference into a short way.
_MIN_NEIGHBOURS_RIGHT = 15
# Acceptance: the last step, the total way from the coarse match, the relative difference of slopes, the residual.
_MAX_STEP_PX = 0.75
_MAX_SHIFT_PX = 1.5
_MAX_SLOPE_DIFFERENCE = 0.3
_MAX_RMS_PX = 0.35
_MAX_STEPS = 2
# So much of the time stamps' noise, per px, may slopes differ beside that share: on average it is 0.1 of it.
_SLOPE_NOISE = 0.5
# Edges flatter than this slide along the row: their place on it is not observed.
MIN_NORMAL_X = 0.15

# Scatter of disparities, against the truth, over what white residuals would make of it: less than a flow's, since
# what an edge's own shape does to its plane it does in both cameras.
INFLATION = 1.1

REFINED, NO_SEED, NO_LEFT_PLANE, FLAT_EDGE, NO_RIGHT_PLANE, FAR, SLOPES, RESIDUAL = range(8)
OUTCOMES = (
    "refined",
    "no_seed",
    "no_left_plane",
    "flat_edge",
    "no_right_plane",
    "too_far",
    "slopes_differ",
    "residual",
)
"""Names of the outcomes, in the order of their numbers."""


class Edges(NamedTuple):
    """The planes of left events on the rectified image; NaN where there is none."""

    x: F64  # (n,) rectified px
    y: F64
    t_s: F64  # (n,) of the plane at the event, before the batch's end (<= 0)
    variance_s2: F64  # (n,) of t_s
    slope_x: F64  # (n,) of the plane, s/px
    slope_y: F64


@dataclass(frozen=True, slots=True)
class Refined:
    """Outcome of each match; the rest is NaN unless it is REFINED."""

    outcome: U8  # (m,)
    disparity: F64  # (m,) px
    sigma_px: F64  # (m,) of the disparity, from the residuals of both planes

    def __getitem__(self, rows: I64) -> Refined:
        return Refined(self.outcome[rows], self.disparity[rows], self.sigma_px[rows])


def left_edges(
    left: U16, unit_ns: int, x: U16, y: U16, p: U8, rectification: Rectification, time_noise_s: float = 0.0
) -> Edges:
    """The edges of events at sensor pixels x, y with polarity p, (n,) each.

    ``left`` (2, h, w) is the first-of-burst surface on the sensor grid, ages in steps of ``unit_ns``; time stamps
    have an error of ``time_noise_s``.
    """
    at = rectification.left_xy[y, x].astype(np.float64)
    n = len(x)
    out = Edges(at[:, 0].copy(), at[:, 1].copy(), np.empty(n), np.empty(n), np.empty(n), np.empty(n))
    _left_edges(
        readonly(left, np.uint16),
        unit_ns / NS_PER_S,
        x.astype(np.int64),
        y.astype(np.int64),
        p.astype(np.int64),
        rectification.left_covector,
        time_noise_s,
        np.empty(WIDE_SIZE + SIZE),
        out,
    )
    return out


def refine(
    edges: Edges,
    right: U16,
    unit_ns: int,
    p: U8,
    of: I64,
    seed_px: F64,
    rectification: Rectification,
    time_noise_s: float = 0.0,
) -> Refined:
    """Refine the disparities ``seed_px`` (m,) (NaN: none), each of that edge ``of`` (m,) those with polarity p (n,).

    ``right`` (2, h, w), ``unit_ns`` and ``time_noise_s`` as of ``left_edges``.
    """
    m = len(of)
    out = Refined(np.empty(m, np.uint8), np.empty(m), np.empty(m))
    _refine(
        readonly(right, np.uint16),
        unit_ns / NS_PER_S,
        p.astype(np.int64),
        of,
        seed_px,
        edges,
        rectification.right_covector,
        rectification.remap_right[0],
        rectification.remap_right[1],
        time_noise_s,
        np.empty(WIDE_SIZE + SIZE),
        out.outcome,
        out.disparity,
        out.sigma_px,
    )
    return out


@njit(cache=True, nogil=True)
def _plane(
    surface: U16, p: int, x: int, y: int, unit_s: float, min_neighbours: int, time_noise_s: float, age: F64
) -> PlaneFit:
    """The widened plane at (x, y), none as of ``fit_plane`` where its neighbours leave the sensor; ``age``: room."""
    if x < REACH or x >= surface.shape[2] - REACH or y < REACH or y >= surface.shape[1] - REACH:
        return 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    wide, inner = age[:WIDE_SIZE], age[WIDE_SIZE:]
    for i in range(WIDE):
        row = surface[p, y + i - REACH, x - REACH : x + REACH + 1]
        for j in range(WIDE):
            wide[i * WIDE + j] = row[j] * unit_s
    for i in range(SIZE):
        inner[i] = wide[INNER_AT[i]]
    fit = fit_plane(inner, _REJECT_PX, _REJECTIONS, min_neighbours, time_noise_s)
    return widen_plane(fit, wide, _REJECT_PX, _MAX_RMS_PX, time_noise_s)[0] if fit[0] > 0 else fit


@njit(cache=True, nogil=True)
def _bilinear(table: F32, x: float, y: float) -> float:
    """Value of a table (h, w) at (x, y); NaN outside."""
    h, w = table.shape
    if not (0.0 <= x <= w - 1 and 0.0 <= y <= h - 1):
        return math.nan
    i, j = min(int(y), h - 2), min(int(x), w - 2)
    a, b = x - j, y - i
    upper = (1.0 - a) * table[i, j] + a * table[i, j + 1]
    lower = (1.0 - a) * table[i + 1, j] + a * table[i + 1, j + 1]
    return float((1.0 - b) * upper + b * lower)


@njit(cache=True, nogil=True)
def _refine_one(
    right: U16,
    unit_s: float,
    p: int,
    edges: Edges,
    k: int,
    seed: float,
    right_covector: F32,
    map_x: F32,
    map_y: F32,
    time_noise_s: float,
    age: F64,
) -> tuple[int, float, float]:
    """(outcome, disparity, its sigma) of edge ``k``, which has polarity ``p``, from the disparity ``seed`` on."""
    x_left, y_left, gx_left, gy_left = edges.x[k], edges.y[k], edges.slope_x[k], edges.slope_y[k]
    x = x_left - seed
    for _ in range(_MAX_STEPS):
        sensor_x = _bilinear(map_x, x, y_left)
        sensor_y = _bilinear(map_y, x, y_left)
        if not (math.isfinite(sensor_x) and math.isfinite(sensor_y)):
            return NO_RIGHT_PLANE, math.nan, math.nan
        px, py = round(sensor_x), round(sensor_y)
        n, gx, gy, t0, rms, _qxx, _qxy, _qyy = _plane(
            right, p, px, py, unit_s, _MIN_NEIGHBOURS_RIGHT, time_noise_s, age
        )
        if n == 0:
            return NO_RIGHT_PLANE, math.nan, math.nan
        M = right_covector[py, px]
        gx_right = M[0, 0] * gx + M[0, 1] * gy
        gy_right = M[1, 0] * gx + M[1, 1] * gy
        # t_R(x + step) = t_L along the rectified row
        t_right = t0 + gx * (sensor_x - px) + gy * (sensor_y - py)
        step = (edges.t_s[k] - t_right) / gx_right if gx_right != 0.0 else math.inf
        x += step
        if not abs(x_left - x - seed) < _MAX_SHIFT_PX:
            return FAR, math.nan, math.nan
        if abs(step) < _MAX_STEP_PX:
            slope = math.sqrt(gx_left * gx_left + gy_left * gy_left)
            difference = math.sqrt((gx_right - gx_left) ** 2 + (gy_right - gy_left) ** 2)
            norm = math.sqrt(gx * gx + gy * gy)
            if difference > math.hypot(_MAX_SLOPE_DIFFERENCE * slope, _SLOPE_NOISE * time_noise_s):
                return SLOPES, math.nan, math.nan
            if rms_px(rms, norm * norm, time_noise_s) > _MAX_RMS_PX:
                return RESIDUAL, math.nan, math.nan
            variance = edges.variance_s2[k] + honest_rms(n, rms, norm, time_noise_s) ** 2 / n
            return REFINED, x_left - x, INFLATION * math.sqrt(variance) / abs(gx_right)
    return FAR, math.nan, math.nan


@njit(cache=True, nogil=True)
def _left_edges(
    left: U16,
    unit_s: float,
    x: I64,
    y: I64,
    p: I64,
    covector: F32,
    time_noise_s: float,
    age: F64,
    edges: Edges,
) -> None:
    """``left_edges`` into what follows from the planes; ``age``: room."""
    for k in range(len(x)):
        edges.t_s[k] = edges.variance_s2[k] = edges.slope_x[k] = edges.slope_y[k] = math.nan
        n, gx, gy, t0, rms, _qxx, _qxy, _qyy = _plane(
            left, p[k], x[k], y[k], unit_s, _MIN_NEIGHBOURS, time_noise_s, age
        )
        slope = math.sqrt(gx * gx + gy * gy)
        if n == 0 or not slope > 0.0:
            continue
        M = covector[y[k], x[k]]
        edges.t_s[k] = t0
        edges.variance_s2[k] = honest_rms(n, rms, slope, time_noise_s) ** 2 / n
        edges.slope_x[k] = M[0, 0] * gx + M[0, 1] * gy
        edges.slope_y[k] = M[1, 0] * gx + M[1, 1] * gy


@njit(cache=True, nogil=True)
def _refine(
    right: U16,
    unit_s: float,
    p: I64,
    of: I64,
    seed: F64,
    edges: Edges,
    right_covector: F32,
    map_x: F32,
    map_y: F32,
    time_noise_s: float,
    age: F64,
    outcome: U8,
    disparity: F64,
    sigma_px: F64,
) -> None:
    """``refine`` into the last three arguments; ``age``: room."""
    for i in range(len(of)):
        k = of[i]
        disparity[i] = sigma_px[i] = math.nan
        slope = math.hypot(edges.slope_x[k], edges.slope_y[k])
        if not slope > 0.0:
            outcome[i] = NO_LEFT_PLANE
        elif not math.isfinite(seed[i]):
            outcome[i] = NO_SEED
        elif abs(edges.slope_x[k]) < MIN_NORMAL_X * slope:
            outcome[i] = FLAT_EDGE
        else:
            outcome[i], disparity[i], sigma_px[i] = _refine_one(
                right, unit_s, p[k], edges, k, seed[i], right_covector, map_x, map_y, time_noise_s, age
            )
