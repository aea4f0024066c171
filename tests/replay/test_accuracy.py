"""Simulated sensors through all four stages: gates wide enough to be stable, too narrow for a broken sign."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from velod.config import Settings
from velod.eval.metrics import Metrics, evaluate
from velod.eval.stage_errors import StageErrors, StageTruthError, stage_errors
from velod.geometry.calibration import Calibration
from velod.io import Recording, open_recording, read_depth
from velod.runtime.offline import run_offline
from velod.types import DepthBatch, FlowBatch, Message

SEQUENCES = {"corridor-1": 0.6, "boxes-4": 0.6}


@dataclass(frozen=True)
class Run:
    path: Path
    recording: Recording
    metrics: Metrics
    flows: list[FlowBatch]
    depths: list[DepthBatch]

    def stage_errors(self, calibration: Calibration | None = None) -> StageErrors:
        depth = read_depth(self.path)
        assert depth is not None
        assert self.recording.truth is not None
        return stage_errors(
            calibration or self.recording.calibration, self.recording.truth, depth, self.flows, self.depths
        )


@pytest.fixture(scope="module", params=SEQUENCES)
def run(request: pytest.FixtureRequest, simulated: Callable[[str, float], Path]) -> Run:
    path = simulated(request.param, SEQUENCES[request.param])
    recording = open_recording(path)
    flows: list[FlowBatch] = []
    depths: list[DepthBatch] = []

    def keep(message: Message) -> None:
        if isinstance(message, FlowBatch):
            flows.append(message)
        elif isinstance(message, DepthBatch):
            depths.append(message)

    velocities = run_offline(Settings(), recording.calibration, recording.packets(), keep)
    assert recording.truth is not None
    return Run(path, recording, evaluate(velocities, recording.truth, recording.t_start_ns), flows, depths)


def test_the_velocity_is_right_without_any_truth_given(run: Run) -> None:
    assert run.metrics.ave_mps < 0.12
    assert run.metrics.rve_percent < 5.0
    assert run.metrics.first_valid_s <= 0.3
    assert run.metrics.valid_fraction == 1.0
    assert run.metrics.n > 20


def test_the_covariance_is_no_idle_claim(run: Run) -> None:
    assert 0.2 < run.metrics.nees_mean < 9.0
    assert run.metrics.within_3_sigma > 0.8


def test_normal_flow_is_right_and_its_sigma_honest(run: Run) -> None:
    errors = run.stage_errors()
    assert errors.flows > 500
    assert abs(errors.flow_bias) < 0.01
    assert errors.flow_spread < 0.045
    assert errors.flow_outliers < 0.01
    assert 0.4 < errors.flow_sigmas < 1.6


def test_disparity_is_right_and_its_sigma_honest(run: Run) -> None:
    errors = run.stage_errors()
    assert errors.disparities > 500
    assert abs(errors.disparity_bias_px) < 0.04
    assert errors.disparity_mad_px < 0.12
    assert errors.disparity_wrong < 0.02
    assert 0.5 < errors.disparity_sigmas < 1.6


def test_the_judge_of_the_stages_sees_a_wrong_baseline_and_a_shifted_disparity(run: Run) -> None:
    calibration = run.recording.calibration
    wider = replace(calibration, t_RL=1.05 * calibration.t_RL)
    assert run.stage_errors(wider).disparity_bias_px < -0.25
    shifted = [replace(batch, disparity=batch.disparity + np.float32(0.5)) for batch in run.depths]
    assert replace(run, depths=shifted).stage_errors().disparity_bias_px == pytest.approx(0.5, abs=0.04)
    faster = [replace(batch, speed=1.1 * batch.speed) for batch in run.flows]
    assert replace(run, flows=faster).stage_errors().flow_bias == pytest.approx(0.1, abs=0.012)


def test_stages_are_not_judged_where_the_depth_images_do_not_fit(run: Run) -> None:
    calibration = run.recording.calibration
    lens = replace(calibration.left, model="equi", dist=(0.1, 0.0, 0.0, 0.0))
    with pytest.raises(StageTruthError, match="undistorted"):
        run.stage_errors(replace(calibration, left=lens, right=lens))
