"""How far normal flow and disparity are from the truth, stage by stage, by distance, edge direction and the like.

Events beside a jump of depth are left out of the sums, and judged apart.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from velod.config import DepthSettings
from velod.eval.judged_events import MIN_FLOW_PX_S, JudgedEvents, judged_events
from velod.eval.scene_truth import TrueDepth
from velod.events.sensor_size import max_disparity_px
from velod.geometry.calibration import Calibration
from velod.geometry.rectify import rectify
from velod.io.model import Truth
from velod.types import F64, DepthBatch, EventBatch, FlowBatch

Bools = NDArray[np.bool_]

OUTLIER = 0.5
"""A flow is an outlier when it is off by more than half of the truth."""

WRONG_PX = 2.0
"""A match is wrong when its disparity is off by more."""

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
    late_s: float  # by which delay of the stamps errors follow the change of the true flow
    late_se_s: float  # standard error of it, from blocks of time


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
    settings = replace(settings, max_disparity_px=max_disparity_px(settings, calibration.left.width))
    e = judged_events(calibration, truth, true_depth, selected, flows, depths)
    clear, has_flow, has_depth = e.known & ~e.jump, np.isfinite(e.ratio), np.isfinite(e.disparity_px)
    possible = clear & e.matchable(rectify(calibration), settings)
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


def _binned(unit: str, edges: Sequence[float], values: F64) -> Iterator[tuple[str, Bools]]:
    """Which rows lie between each edge and the next, after the last one too."""
    for low, high in pairwise((*edges, math.inf)):
        label = f"{low:g} to {high:g}" if math.isfinite(high) else f"above {low:g}"
        yield f"{label} {unit}".strip(), np.asarray((values >= low) & (values < high))


def _of_flow(e: JudgedEvents, rows: Bools) -> FlowErrors:
    rows = rows & np.isfinite(e.ratio)
    ratio, scaled = e.ratio[rows], e.flow_sigmas[rows]
    late_s, late_se_s = _late(e.speed[rows] - e.true_speed[rows], scaled, e.change[rows])
    return FlowErrors(
        n=len(ratio),
        bias=_median(ratio) - 1.0,
        bias_se=_standard_error(ratio),
        spread=_spread(ratio),
        outliers=_share(np.abs(ratio - 1.0) > OUTLIER),
        sigmas=_spread(scaled),
        std=_std(scaled),
        beyond_4=_share(np.abs(scaled) > 4.0),
        late_s=late_s,
        late_se_s=late_se_s,
    )


def _of_depth(e: JudgedEvents, rows: Bools) -> DepthErrors:
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


def _late(error: F64, scaled: F64, change: F64) -> tuple[float, float]:
    """Delay of the stamps, s, and its standard error: the flow is that of a moment before, error = -delay x change.

    Least squares of the errors (n,), px/s, within 4 of their sigmas; NaN of few, and where nothing changes.
    """
    near = np.isfinite(change) & (np.abs(scaled) <= 4.0) & (scaled != 0.0)
    if np.count_nonzero(near) < 10 * _BLOCKS:
        return math.nan, math.nan
    error, change, weight = error[near], change[near], (scaled[near] / error[near]) ** 2
    per_block = [
        (np.sum(w * e * c), np.sum(w * c * c))
        for w, e, c in zip(*(np.array_split(v, _BLOCKS) for v in (weight, error, change)), strict=True)
    ]
    along, square = np.array(per_block).T
    if not square.sum() > 0.0:
        return math.nan, math.nan
    late = -along.sum() / square.sum()
    left = along + late * square
    return float(late), float(np.sqrt(np.sum(left**2) * _BLOCKS / (_BLOCKS - 1)) / square.sum())


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
