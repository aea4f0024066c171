"""Every selected event beside its truth: what flow and depth made of it, and what they should have made.

The truth of an event is that of its own time and of its own, sub-pixel place on the rectified image. One beside a
jump of depth may belong to either surface: of the depths around it that counts which fits better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from velod.config import DepthSettings
from velod.eval.scene_truth import TrueDepth, motion_of_camera, rays
from velod.geometry.calibration import Calibration
from velod.geometry.camera import motion_field_rows
from velod.geometry.rectify import Rectification, rectify
from velod.io.model import Truth
from velod.optimizer.parts import batch_seq
from velod.types import F64, I64, NS_PER_S, DepthBatch, EventBatch, FlowBatch

Bools = NDArray[np.bool_]

MIN_FLOW_PX_S = 20.0
"""A slower true normal flow has no ratio worth the name."""

AROUND = np.array([(0, 0), *((a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0))])
"""(9, 2): where depth is looked up, at an event and around it, in steps of _AROUND_PX."""
_AROUND_PX = 2.5
_OPPOSITE = (1, 8), (2, 7), (3, 6), (4, 5)
_STEP = 0.05
"""Inverse depths around an event that are off a plane's by this share are not those of one surface: on a plane,
however it leans, inverse depth is linear. Where the disparity is 7 px, 5 % are 0.35 px, ten of its sigmas."""
_CHANGE_NS = 2_000_000
_HIDDEN = 0.02  # the right camera sees something nearer by this share


@dataclass(frozen=True, slots=True)
class JudgedEvents:
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
    change: F64  # of true_speed in time at that place, px/s^2
    ratio: F64  # measured / true flow; NaN also where the true one is slow
    flow_sigmas: F64
    disparity_px: F64  # error
    depth_ratio: F64
    inverse_sigmas: F64
    refined: Bools

    def matchable(self, rect: Rectification, settings: DepthSettings) -> Bools:
        """(n,) where the geometry allows a depth: both cameras see it, search and block stay inside the images."""
        d, half = rect.f * rect.baseline_m / self.z, settings.block_px // 2
        with np.errstate(invalid="ignore"):
            inside_x = (self.x >= half) & (self.x - d >= half) & (self.x < rect.width - half)
            inside_y = (self.y >= half) & (self.y < rect.height - half)
            in_range = (d >= settings.min_disparity_px) & (d <= settings.max_disparity_px - 1)
        return inside_x & inside_y & in_range & self.in_right


def judged_events(
    calibration: Calibration,
    truth: Truth,
    true_depth: TrueDepth,
    selected: Sequence[EventBatch],
    flows: Sequence[FlowBatch],
    depths: Sequence[DepthBatch],
) -> JudgedEvents:
    """Every event of ``selected``, in order, beside its truth."""
    rect = rectify(calibration)
    first = np.cumsum([0, *(len(batch.x) for batch in selected)])
    begin = {batch.seq: int(k) for batch, k in zip(selected, first, strict=False)}
    # Event by event a batch comes in parts, of which depth answers all at once.
    whole = {batch_seq(batch): begin[batch.seq] for batch in selected if batch.first == 0}
    t_ns = np.concatenate([np.empty(0, np.int64), *(b.t_ns - b.age.astype(np.int64) for b in selected)])
    i, j, p = (np.concatenate([np.empty(0, np.uint8), *(getattr(b, c) for b in selected)]) for c in ("x", "y", "p"))
    x, y = rect.left_xy[j.astype(np.int64), i.astype(np.int64)].astype(np.float64).T
    flow = _spread_out(len(t_ns), begin, flows, ("n", "speed", "sigma"))
    depth = _spread_out(len(t_ns), whole, depths, ("disparity", "inv_depth", "sigma", "refined"))
    seen = _look(true_depth, rect, t_ns, x, y)
    z, jump, f_b = seen[:, 0], beside_jump(seen), rect.f * rect.baseline_m
    speed, inv_depth = flow["speed"][:, 0], depth["inv_depth"][:, 0]
    true_speed = _best(_true_flow(truth, rect, t_ns, x, y, flow["n"], seen), speed, jump)
    before, after = (
        _true_flow(truth, rect, t_ns + way_ns, x, y, flow["n"], seen[:, :1])[:, 0]
        for way_ns in (-_CHANGE_NS, _CHANGE_NS)
    )
    slow = ~(np.abs(true_speed) > MIN_FLOW_PX_S)
    true_inv_depth = _best(1.0 / seen, inv_depth, jump)
    right_z = true_depth(t_ns, rays(rect, x - f_b / z, y)[:, None], rect.baseline_m)[:, 0]
    return JudgedEvents(
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
        change=(after - before) * (0.5 * NS_PER_S / _CHANGE_NS),
        ratio=np.where(slow, np.nan, speed / true_speed),
        flow_sigmas=(speed - true_speed) / flow["sigma"][:, 0],
        disparity_px=depth["disparity"][:, 0] - f_b * true_inv_depth,
        depth_ratio=true_inv_depth / inv_depth,
        inverse_sigmas=(inv_depth - true_inv_depth) / depth["sigma"][:, 0],
        refined=depth["refined"][:, 0] == 1.0,
    )


def beside_jump(seen: F64) -> Bools:
    """(n,) where the inverses of the depths (n, 9) at and around an event are off a plane's by _STEP, or unknown."""
    inverse = 1.0 / seen
    bends = [inverse[:, i] + inverse[:, j] - 2.0 * inverse[:, 0] for i, j in _OPPOSITE]
    return np.asarray(~(np.max(np.abs(bends), axis=0) <= _STEP * inverse[:, 0]))


def _true_flow(truth: Truth, rect: Rectification, t_ns: I64, x: F64, y: F64, n: F64, z: F64) -> F64:
    """(n, k) normal flows, px/s, along the measured directions ``n`` (n, 2) at each of the depths ``z`` (n, k), m."""
    v_C, w_C = motion_of_camera(truth, rect, t_ns)
    nA, nB = motion_field_rows(x, y, rect.f, rect.cx, rect.cy, n)
    # Eq. 4
    return np.asarray(np.sum(nA * v_C, axis=1)[:, None] / z + np.sum(nB * w_C, axis=1)[:, None])


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
    step = _AROUND_PX * AROUND
    return true_depth(t_ns, rays(rect, x[:, None] + step[:, 0], y[:, None] + step[:, 1]))


def _best(candidates: F64, measured: F64, choose: Bools) -> F64:
    """(n,) the first of each row's candidates (n, k), or where ``choose`` the one nearest to what was measured."""
    off = np.abs(candidates - measured[:, None])
    nearest = np.argmin(np.where(np.isfinite(off), off, np.inf), axis=1)
    at = np.where(choose & np.isfinite(measured), nearest, 0)
    best: F64 = candidates[np.arange(len(at)), at]
    return np.where(np.isfinite(measured), best, np.nan)
