"""How far normal flow and disparity are from a simulator's truth, stage by stage.

Truth comes from the motion and from depth images of the left camera, which are exact at their own moments only:
events further than NEAR_NS from one, or beside a jump of depth, are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from velod.eval.metrics import interpolated
from velod.geometry.calibration import Calibration
from velod.geometry.camera import motion_field_rows
from velod.io.model import DepthTruth, Truth
from velod.types import F32, F64, I64, DepthBatch, FlowBatch

NEAR_NS = 4_000_000
_JUMP = 0.15  # range of depth over the 6 x 6 pixels around, relative
_MIN_FLOW_PX_S = 20.0
_WRONG_PX = 2.0


class StageTruthError(ValueError):
    """A truth that stages cannot be judged by; the text says why."""


@dataclass(frozen=True, slots=True)
class StageErrors:
    """Medians and robust spreads (half of the 16 to 84 % range); NaN where nothing could be judged."""

    flows: int
    flow_bias: float  # median of measured / true normal flow, minus 1
    flow_spread: float
    flow_outliers: float  # share off by more than half
    flow_sigmas: float  # spread of the error in units of its stated sigma; 1 is honest
    disparities: int
    disparity_bias_px: float
    disparity_mad_px: float
    disparity_wrong: float  # share off by more than 2 px
    disparity_sigmas: float


def stage_errors(
    calibration: Calibration,
    truth: Truth,
    depth: DepthTruth,
    flows: Sequence[FlowBatch],
    depths: Sequence[DepthBatch],
) -> StageErrors:
    """Judge the batches of one run. The cameras must be rectified and free of distortion, B the left camera.

    Raises StageTruthError for another rig: the depth images are on the sensor's own pixels.
    """
    camera = calibration.left
    if camera.model != "none" or not np.array_equal(calibration.T_cam_imu, np.eye(4)):
        raise StageTruthError("stage errors need undistorted cameras, and the left one as body")
    matched = {batch.seq: batch for batch in depths}
    ratios, flow_errors, disparity_errors, disparity_sigmas = ([np.empty(0)] for _ in range(4))
    for batch in flows:
        true_z = _depth_near(depth, batch.t_ns - batch.age.astype(np.int64), batch.x, batch.y)
        ratio, error = _flow_errors(calibration, truth, batch, true_z)
        ratios.append(ratio)
        flow_errors.append(error)
        if batch.seq in matched:
            error, sigma = _disparity_errors(calibration, batch, matched[batch.seq], true_z)
            disparity_errors.append(error)
            disparity_sigmas.append(error / sigma)
    ratio, flow_error, error, scaled = (
        np.concatenate(parts) for parts in (ratios, flow_errors, disparity_errors, disparity_sigmas)
    )
    return StageErrors(
        flows=len(ratio),
        flow_bias=_median(ratio) - 1.0,
        flow_spread=_spread(ratio),
        flow_outliers=_share(np.abs(ratio - 1.0) > 0.5),
        flow_sigmas=_spread(flow_error),
        disparities=len(error),
        disparity_bias_px=_median(error),
        disparity_mad_px=_median(np.abs(error - _median(error))),
        disparity_wrong=_share(np.abs(error) > _WRONG_PX),
        disparity_sigmas=_spread(scaled),
    )


def _flow_errors(calibration: Calibration, truth: Truth, batch: FlowBatch, true_z: F64) -> tuple[F64, F64]:
    """Measured / true normal flow, and the error in stated sigmas, where the truth is known and not slow."""
    known = np.isfinite(true_z)
    x, y, n, z, speed, sigma = (
        a[known].astype(np.float64) for a in (batch.x, batch.y, batch.n, true_z, batch.speed, batch.sigma)
    )
    t_ns = batch.t_ns - batch.age[known].astype(np.int64)
    v, w = (interpolated(truth.t_ns, values, t_ns) for values in (truth.v_B, truth.omega_B))
    camera = calibration.left
    nA, nB = motion_field_rows(x, y, camera.fx, camera.cx, camera.cy, n)
    # Eq. 4
    true_flow = np.sum(nA * v, axis=1) / z + np.sum(nB * w, axis=1)
    fast = np.abs(true_flow) > _MIN_FLOW_PX_S
    return speed[fast] / true_flow[fast], ((speed - true_flow) / sigma)[fast]


def _disparity_errors(calibration: Calibration, flows: FlowBatch, depths: DepthBatch, true_z: F64) -> tuple[F64, F64]:
    """Disparity errors and stated sigmas, px, of the events that have both a flow and a disparity."""
    _, at_flow, at_depth = np.intersect1d(flows.index, depths.index, return_indices=True)
    f_b = calibration.left.fx * -float(calibration.t_RL[0])
    error = depths.disparity[at_depth].astype(np.float64) - f_b / true_z[at_flow]
    known = np.isfinite(error)
    return error[known], depths.sigma[at_depth][known].astype(np.float64) * f_b


def _depth_near(depth: DepthTruth, t_ns: I64, x: F32, y: F32) -> F64:
    """True depth (n,) at sub-pixel positions; NaN without an image near in time, and beside a jump."""
    nearest = np.argmin(np.abs(t_ns[:, None] - depth.t_ns), axis=1)
    i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    height, width = depth.left.shape[1:]
    usable = (
        (np.abs(t_ns - depth.t_ns[nearest]) <= NEAR_NS) & (i >= 2) & (j >= 2) & (i < width - 3) & (j < height - 3)
    )
    result = np.full(len(t_ns), np.nan)
    k, i, j = nearest[usable], i[usable], j[usable]
    # Inverse depth is linear over a plane.
    corner = [[1.0 / depth.left[k, j + b, i + a].astype(np.float64) for a in (0, 1)] for b in (0, 1)]
    p, q = x[usable] - i, y[usable] - j
    inverse = (1 - q) * ((1 - p) * corner[0][0] + p * corner[0][1]) + q * ((1 - p) * corner[1][0] + p * corner[1][1])
    around = np.stack([depth.left[k, j + b, i + a] for b in (-2, 0, 1, 3) for a in (-2, 0, 1, 3)])
    smooth = around.max(axis=0) - around.min(axis=0) < _JUMP * around.mean(axis=0)
    result[usable] = np.where(smooth, 1.0 / inverse, np.nan)
    return result


def _median(values: F64) -> float:
    return float(np.median(values)) if len(values) else math.nan


def _spread(values: F64) -> float:
    if len(values) == 0:
        return math.nan
    low, high = np.percentile(values, (16, 84))
    return float(high - low) / 2


def _share(flags: NDArray[np.bool_]) -> float:
    return float(flags.mean()) if len(flags) else math.nan
