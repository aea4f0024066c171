"""The floor: velod's own selection, positions and edge directions, but with perfect flow and depth.

What the back end makes of them is what the IMU's noise, and the choice of events, leave.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from velod.eval.front_end import FrontEnd, event_times
from velod.eval.metrics import interpolated
from velod.geometry.calibration import Calibration
from velod.geometry.camera import motion_field_rows
from velod.io.model import Truth
from velod.types import F64, I64, DepthBatch, FlowBatch

TrueDepth = Callable[[I64, F64, F64], F64]
"""Depth (m,), m along the left camera's z, at times ``t_ns`` and positions ``x``, ``y`` on its image, (m,) each."""

SPEED_SIGMA_PX_S = 0.1
INV_DEPTH_SIGMA_SHARE = 1e-3
"""Of the replaced values: above what float32 and the 1 kHz truth leave, far below any measurement."""


class FloorError(ValueError):
    """No floor can be had for this rig; the text says why."""


def has_floor(calibration: Calibration) -> bool:
    """Whether the cameras are free of distortion and the left one is the body: all that the floor can be had for."""
    return calibration.left.model == "none" and bool(np.array_equal(calibration.T_cam_imu, np.eye(4)))


def with_perfect_flow_and_depth(
    front_end: FrontEnd, calibration: Calibration, truth: Truth, true_depth: TrueDepth
) -> FrontEnd:
    """Speed by Eq. 4 for the measured n, and inverse depth, both from the simulator, where flow and depth were found.

    Raises FloorError unless the cameras are free of distortion and the left one is the body.
    """
    camera = calibration.left
    if not has_floor(calibration):
        raise FloorError("the floor needs undistorted cameras, and the left one as body")
    f_b = camera.fx * -float(calibration.t_RL[0])

    def perfect(flow: FlowBatch, depth: DepthBatch) -> tuple[FlowBatch, DepthBatch]:
        t_ns, x, y, n = event_times(flow), *(a.astype(np.float64) for a in (flow.x, flow.y, flow.n))
        inverse = 1.0 / true_depth(t_ns, x, y)
        v, w = (interpolated(truth.t_ns, values, t_ns) for values in (truth.v_B, truth.omega_B))
        nA, nB = motion_field_rows(x, y, camera.fx, camera.cx, camera.cy, n)
        # Eq. 4
        speed = np.sum(nA * v, axis=1) * inverse + np.sum(nB * w, axis=1)
        # n points along the motion: where the truth goes the other way, so does the perfect flow.
        sign = np.where(speed < 0.0, -1.0, 1.0)
        return (
            replace(
                flow,
                n=(n * sign[:, None]).astype(np.float32),
                speed=np.abs(speed).astype(np.float32),
                sigma=np.full(len(x), SPEED_SIGMA_PX_S, np.float32),
            ),
            replace(
                depth,
                disparity=(f_b * inverse).astype(np.float32),
                inv_depth=inverse.astype(np.float32),
                sigma=(INV_DEPTH_SIGMA_SHARE * inverse).astype(np.float32),
            ),
        )

    return front_end.with_batches(perfect)
