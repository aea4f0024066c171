"""The floor: velod's own selection, positions and edge directions, but with true flow and depth.

What the back end makes of them is what the IMU's noise, and the choice of events, leave.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from velod.eval.front_end import FrontEnd, event_times, taken
from velod.eval.scene_truth import TrueDepth, motion_of_camera, rays
from velod.geometry.calibration import Calibration
from velod.geometry.camera import motion_field_rows
from velod.geometry.rectify import rectify
from velod.io.model import Truth
from velod.types import DepthBatch, FlowBatch

SPEED_SIGMA_PX_S = 0.1
INV_DEPTH_SIGMA_SHARE = 1e-3
"""Of the replaced values: above what float32 and the 1 kHz truth leave, far below any measurement."""


def with_perfect_flow_and_depth(
    front_end: FrontEnd, calibration: Calibration, truth: Truth, true_depth: TrueDepth
) -> FrontEnd:
    """Speed by Eq. 4 for the measured n, and inverse depth, both true, where flow and depth were found.

    Without the events whose true depth is not known.
    """
    rect = rectify(calibration)

    def perfect(flow: FlowBatch, depth: DepthBatch) -> tuple[FlowBatch, DepthBatch]:
        z = true_depth(event_times(flow), rays(rect, flow.x.astype(np.float64), flow.y.astype(np.float64))[:, None])[
            :, 0
        ]
        known = np.flatnonzero(np.isfinite(z))
        flow, depth = taken(flow, depth, known, known)
        inverse, t_ns, n = 1.0 / z[known], event_times(flow), flow.n.astype(np.float64)
        x, y = flow.x.astype(np.float64), flow.y.astype(np.float64)
        v_C, w_C = motion_of_camera(truth, rect, t_ns)
        nA, nB = motion_field_rows(x, y, rect.f, rect.cx, rect.cy, n)
        # Eq. 4
        speed = np.sum(nA * v_C, axis=1) * inverse + np.sum(nB * w_C, axis=1)
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
                disparity=(rect.f * rect.baseline_m * inverse).astype(np.float32),
                inv_depth=inverse.astype(np.float32),
                sigma=(INV_DEPTH_SIGMA_SHARE * inverse).astype(np.float32),
            ),
        )

    return front_end.with_batches(perfect)
