"""The made-up inputs of the warm-up reach every part of the stages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from velod.config import Settings
from velod.geometry.calibration import Calibration, Camera
from velod.runtime import warmup
from velod.runtime.stages import STAGES, create_stage
from velod.types import DepthBatch, EventBatch, FlowBatch, Message, Velocity

BENT = Camera(width=240, height=180, fx=200.0, fy=200.0, cx=120.0, cy=90.0, model="radtan", dist=(-0.3, 0.1, 0, 0, 0))
BENT_RIG = Calibration(left=BENT, right=BENT, R_RL=np.eye(3), t_RL=np.array([-0.1, 0.001, 0.0]))


def outputs(stage: str, calibration: Calibration) -> Sequence[Message]:
    inputs = {
        "ingest": warmup._packets,
        "flow": warmup._event_batches,
        "depth": warmup._stereo_batches,
        "optimizer": warmup._estimates,
    }
    built = create_stage(stage, Settings(), calibration)
    return [m for message in inputs[stage](calibration) for m in built.handle(message)]


def test_ingest_selects_events_from_the_packets() -> None:
    batches = [m for m in outputs("ingest", warmup.plain_calibration()) if isinstance(m, EventBatch)]
    assert max(len(b.x) for b in batches) > 100


def test_flow_finds_the_speed_of_the_edges() -> None:
    (flow,) = outputs("flow", warmup.plain_calibration())
    assert isinstance(flow, FlowBatch)
    assert len(flow.index) > 0.9 * flow.n_selected
    assert np.median(flow.speed) == pytest.approx(250.0 / np.hypot(1.0, 0.3), rel=0.01)


def test_depth_finds_and_refines_the_disparity() -> None:
    (depth,) = outputs("depth", warmup.plain_calibration())
    assert isinstance(depth, DepthBatch)
    assert depth.refined.any()
    assert np.median(depth.disparity[depth.refined == 1]) == pytest.approx(8.0, abs=0.1)


def test_the_optimizer_gets_as_far_as_a_valid_velocity() -> None:
    velocities = [m for m in outputs("optimizer", warmup.plain_calibration()) if isinstance(m, Velocity)]
    assert velocities[-1].valid
    assert velocities[-1].v_B == pytest.approx([1.0, 0.2, 0.1], abs=0.1)


@pytest.mark.parametrize("stage", STAGES)
def test_a_distorted_rig_is_warmed_up_as_well(stage: str) -> None:
    assert warmup.warm_up(stage, Settings(), BENT_RIG) > 0
