"""How far normal flow and disparity are from the truth, stage by stage, by distance, edge direction and the like.

The truth of an event is that of its own time and of its own, sub-pixel place on the rectified image. Events beside a
jump of depth may belong to either surface: they are left out of the sums, and judged apart by what fits better.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from velod.config import DepthSettings
from velod.eval.scene_truth import JUMP, TrueDepth, motion_of_camera, rays
from velod.events.sensor_size import max_disparity_px
from velod.geometry.calibration import Calibration
from velod.geometry.camera import motion_field_rows
from velod.geometry.rectify import Rectification, rectify
from velod.io.model import Truth
from velod.optimizer.parts import batch_seq
from velod.types import F64, I64, DepthBatch, EventBatch, FlowBatch

Bools = NDArray[np.bool_]

MIN_FLOW_PX_S = 20.0
"""A slower true normal flow has no ratio worth the name."""

OUTLIER = 0.5
"""A flow is an outlier when it is off by more than half of the truth."""

WRONG_PX = 2.0
"""A match is wrong when its disparity is off by more."""

_AROUND_PX = 2.5
_HIDDEN = 0.02  # the right camera sees something nearer by this share
_BLOCKS = 20

# Where groups of events begin.
DISTANCES_M = (0.0, 1.5, 2.5, 4.0, 6.0)
DIRECTIONS = (0.0, 0.15, 0.4, 0.7)  # |n_x|: 0 at a horizontal edge
SPEEDS_PX_S = (MIN_FLOW_PX_S, 100.0, 300.0, 1000.0)


@dataclass(frozen=True, slots=True)
class FlowErrors:
    """Of normal flows whose true value is above MIN_FLOW_PX_S; NaN where there are none."""

    n: int
    bias: float  # median of measured / true, minus 1
    bias_se: float  # standard error of it, from the medians of blocks of time; NaN of few
    spread: float  # half of the 16 to 84 % range of the ratio
    outliers: float  # share off by more than OUTLIER
    sigmas: float  # half of the 16 to 84 % range of error / stated sigma; 1 is honest
    std: float  # standard deviation of error / stated sigma, of those within 4
    beyond_4: float  # share of errors above 4 stated sigmas


@dataclass(frozen=True, slots=True)
class DepthErrors:
    """Of disparities (px), and of the depths (relative) and inverse depths (in stated sigmas) that follow."""

    n: int
    bias_px: float  # median
    bias_se_px: float  # standard error of it, as of the flow
    mad_px: float  # median absolute deviation from the median
    wrong: float  # share off by more than WRONG_PX
    z_bias: float  # median of measured / true depth, minus 1
    z_spread: float  # half of the 16 to 84 % range of the ratio
    sigmas: float  # as of the flow
    std: float
    beyond_4: float


@dataclass(frozen=True, slots=True)
class Group:
    """The errors of some of the events."""

    label: str
    flow: FlowErrors
    depth: DepthErrors


@dataclass(frozen=True, slots=True)
class StageErrors:
    """Errors of one run; shares are NaN where there is nothing to count."""

    how: str  # how the truth was looked up
    selected: int  # events
    judged: float  # share of them with a truth, and not beside a jump of depth
    beside_jump: float  # share of those with a truth that are beside a jump, or the edge of what is known
    with_flow: float  # share of the judged that got a flow
    with_depth: float  # share of the judged that got a depth
    with_depth_where_possible: float  # of those that both cameras see, with block and disparity inside the bounds
    refined: float  # share of the depths that were refined
    flow: FlowErrors
    depth: DepthErrors
    refined_depth: DepthErrors
    block_depth: DepthErrors
    groups: dict[str, list[Group]] = field(default_factory=dict)  # by what they are grouped -> groups


def stage_errors(
    calibration: Calibration,
    truth: Truth,
    true_depth: TrueDepth,
    settings: DepthSettings,
    selected: Sequence[EventBatch],
    flows: Sequence[FlowBatch],
    depths: Sequence[DepthBatch],
) -> StageErrors:
    """Judge the batches of one run. ``settings`` tell where a depth can be had at all."""
    rect = rectify(calibration)
    settings = replace(settings, max_disparity_px=max_disparity_px(settings, calibration.left.width))
    e = _Events.of(calibration, truth, true_depth, rect, selected, flows, depths)
    clear, has_flow, has_depth = e.known & ~e.jump, np.isfinite(e.ratio), np.isfinite(e.disparity_px)
    possible = clear & _matchable(e, rect, settings)
    by = {
        "distance": _binned("m", DISTANCES_M, e.z),
        "edge direction, |n_x|": _binned("", DIRECTIONS, np.abs(e.n_x)),
        "flow": _binned("px/s", SPEEDS_PX_S, np.abs(e.true_speed)),
        "polarity": [("ON", e.p == 1), ("OFF", e.p == 0)],
    }
    groups = {
        what: [Group(label, _of_flow(e, clear & rows), _of_depth(e, clear & rows)) for label, rows in parts]
        for what, parts in by.items()
    }
    beside = e.known & e.jump
    groups["place"] = [Group("beside a jump of depth", _of_flow(e, beside), _of_depth(e, beside))]
    return StageErrors(
        how=true_depth.how,
        selected=len(e.t_ns),
        judged=_share(clear),
        beside_jump=_share(e.jump[e.known]),
        with_flow=_share(np.isfinite(e.speed[clear])),
        with_depth=_share(has_depth[clear]),
        with_depth_where_possible=_share(has_depth[possible]),
        refined=_share(e.refined[clear & has_depth]),
        flow=_of_flow(e, clear & has_flow),
        depth=_of_depth(e, clear),
        refined_depth=_of_depth(e, clear & e.refined),
        block_depth=_of_depth(e, clear & ~e.refined),
        groups=groups,
    )


@dataclass(frozen=True, slots=True)
class _Events:
    """Every selected event with its truth, and what flow and depth made of it; (n,) each, NaN where nothing."""

    t_ns: I64
    p: NDArray[np.uint8]
    x: F64  # rectified px
    y: F64
    z: F64  # true depth, m
    known: Bools  # z is
    jump: Bools  # z is not the only depth around
    in_right: Bools  # the right camera sees it
    n_x: F64
    speed: F64  # measured, px/s
    true_speed: F64  # along the measured n; NaN where there is no flow
    ratio: F64  # measured / true flow; NaN also where the true one is slow
    flow_sigmas: F64
    disparity_px: F64  # error
    depth_ratio: F64
    inverse_sigmas: F64
    refined: Bools

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        truth: Truth,
        true_depth: TrueDepth,
        rect: Rectification,
        selected: Sequence[EventBatch],
        flows: Sequence[FlowBatch],
        depths: Sequence[DepthBatch],
    ) -> _Events:
        first = np.cumsum([0, *(len(batch.x) for batch in selected)])
        begin = {batch.seq: int(k) for batch, k in zip(selected, first, strict=False)}
        # Event by event a batch comes in parts, of which depth answers all at once.
        whole = {batch_seq(batch): begin[batch.seq] for batch in selected if batch.first == 0}
        t_ns = np.concatenate([np.empty(0, np.int64), *(b.t_ns - b.age.astype(np.int64) for b in selected)])
        i, j, p = (
            np.concatenate([np.empty(0, np.uint8), *(getattr(b, c) for b in selected)]) for c in ("x", "y", "p")
        )
        x, y = rect.left_xy[j.astype(np.int64), i.astype(np.int64)].astype(np.float64).T
        flow = _spread_out(len(t_ns), begin, flows, ("n", "speed", "sigma"))
        depth = _spread_out(len(t_ns), whole, depths, ("disparity", "inv_depth", "sigma", "refined"))
        seen = _look(true_depth, rect, t_ns, x, y)
        z, candidates = seen[:, 0], seen
        near, far = (f(seen, axis=1) for f in (np.fmin.reduce, np.fmax.reduce))
        jump = ~np.isfinite(seen).all(axis=1) | (far - near > JUMP * 0.5 * (far + near))
        v_C, w_C = motion_of_camera(truth, rect, t_ns)
        nA, nB = motion_field_rows(x, y, rect.f, rect.cx, rect.cy, flow["n"])
        # Eq. 4, at every depth around the event
        true_flow = np.sum(nA * v_C, axis=1)[:, None] / candidates + np.sum(nB * w_C, axis=1)[:, None]
        true_speed = _best(true_flow, flow["speed"][:, 0], jump)
        speed, f_b = flow["speed"][:, 0], rect.f * rect.baseline_m
        inverse = _best(1.0 / candidates, depth["inv_depth"][:, 0], jump)
        slow = ~(np.abs(true_speed) > MIN_FLOW_PX_S)
        right_z = true_depth(t_ns, rays(rect, x - f_b / z, y)[:, None], rect.baseline_m)[:, 0]
        return cls(
            t_ns=t_ns,
            p=p,
            x=x,
            y=y,
            z=z,
            known=np.isfinite(z),
            jump=jump,
            in_right=~(right_z < (1.0 - _HIDDEN) * z),
            n_x=flow["n"][:, 0],
            speed=speed,
            true_speed=true_speed,
            ratio=np.where(slow, np.nan, speed / true_speed),
            flow_sigmas=(speed - true_speed) / flow["sigma"][:, 0],
            disparity_px=depth["disparity"][:, 0] - f_b * inverse,
            depth_ratio=inverse / depth["inv_depth"][:, 0],
            inverse_sigmas=(depth["inv_depth"][:, 0] - inverse) / depth["sigma"][:, 0],
            refined=depth["refined"][:, 0] == 1.0,
        )


def _spread_out(
    n: int, begin: dict[int, int], batches: Sequence[FlowBatch] | Sequence[DepthBatch], names: Sequence[str]
) -> dict[str, F64]:
    """Columns of ``batches``, (n, c) each, at the places of their events among all that were selected."""
    rows = [begin[b.seq] + b.index.astype(np.int64) for b in batches if b.seq in begin]
    at = np.concatenate([np.empty(0, np.int64), *rows])
    out = {}
    for name in names:
        columns = [getattr(b, name).astype(np.float64) for b in batches if b.seq in begin]
        parts = [c if c.ndim == 2 else c[:, None] for c in columns]
        out[name] = np.full((n, parts[0].shape[1] if parts else 2), np.nan)
        out[name][at] = np.concatenate(parts) if parts else np.empty((0, 2))
    return out


def _look(true_depth: TrueDepth, rect: Rectification, t_ns: I64, x: F64, y: F64) -> F64:
    """(n, 9): depth at each event, and _AROUND_PX from it in eight directions."""
    step = _AROUND_PX * np.array([(0, 0), *((a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0))])
    return true_depth(t_ns, rays(rect, x[:, None] + step[:, 0], y[:, None] + step[:, 1]))


def _best(candidates: F64, measured: F64, choose: Bools) -> F64:
    """(n,) the first of each row's candidates (n, k), or where ``choose`` the one nearest to what was measured."""
    off = np.abs(candidates - measured[:, None])
    nearest = np.argmin(np.where(np.isfinite(off), off, np.inf), axis=1)
    at = np.where(choose & np.isfinite(measured), nearest, 0)
    best: F64 = candidates[np.arange(len(at)), at]
    return np.where(np.isfinite(measured), best, np.nan)


def _matchable(e: _Events, rect: Rectification, settings: DepthSettings) -> Bools:
    """Where the geometry allows a depth: both cameras see the place, and search and block stay inside the images."""
    d, half = rect.f * rect.baseline_m / e.z, settings.block_px // 2
    with np.errstate(invalid="ignore"):
        inside_x = (e.x >= half) & (e.x - d >= half) & (e.x < rect.width - half)
        inside_y = (e.y >= half) & (e.y < rect.height - half)
        in_range = (d >= settings.min_disparity_px) & (d <= settings.max_disparity_px - 1)
    return inside_x & inside_y & in_range & e.in_right


def _binned(unit: str, edges: Sequence[float], values: F64) -> Iterator[tuple[str, Bools]]:
    """Which rows lie between each edge and the next, after the last one too."""
    for low, high in pairwise((*edges, math.inf)):
        label = f"{low:g} to {high:g}" if math.isfinite(high) else f"above {low:g}"
        yield f"{label} {unit}".strip(), np.asarray((values >= low) & (values < high))


def _of_flow(e: _Events, rows: Bools) -> FlowErrors:
    rows = rows & np.isfinite(e.ratio)
    ratio, scaled = e.ratio[rows], e.flow_sigmas[rows]
    return FlowErrors(
        n=len(ratio),
        bias=_median(ratio) - 1.0,
        bias_se=_standard_error(ratio),
        spread=_spread(ratio),
        outliers=_share(np.abs(ratio - 1.0) > OUTLIER),
        sigmas=_spread(scaled),
        std=_std(scaled),
        beyond_4=_share(np.abs(scaled) > 4.0),
    )


def _of_depth(e: _Events, rows: Bools) -> DepthErrors:
    rows = rows & np.isfinite(e.disparity_px)
    error, ratio, scaled = e.disparity_px[rows], e.depth_ratio[rows], e.inverse_sigmas[rows]
    return DepthErrors(
        n=len(error),
        bias_px=_median(error),
        bias_se_px=_standard_error(error),
        mad_px=_median(np.abs(error - _median(error))),
        wrong=_share(np.abs(error) > WRONG_PX),
        z_bias=_median(ratio) - 1.0,
        z_spread=_spread(ratio),
        sigmas=_spread(scaled),
        std=_std(scaled),
        beyond_4=_share(np.abs(scaled) > 4.0),
    )


def _median(values: F64) -> float:
    return float(np.median(values)) if len(values) else math.nan


def _standard_error(values: F64) -> float:
    """Of the median: from the medians of blocks of time, as neighbours share errors."""
    if len(values) < 10 * _BLOCKS:
        return math.nan
    medians = [np.median(block) for block in np.array_split(values, _BLOCKS)]
    return float(np.std(medians, ddof=1)) / math.sqrt(_BLOCKS)


def _spread(values: F64) -> float:
    if len(values) == 0:
        return math.nan
    low, high = np.percentile(values, (16, 84))
    return float(high - low) / 2


def _std(scaled: F64) -> float:
    near = scaled[np.abs(scaled) <= 4.0]
    return float(np.std(near)) if len(near) else math.nan


def _share(flags: Bools) -> float:
    return float(flags.mean()) if len(flags) else math.nan
