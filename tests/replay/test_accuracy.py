"""Simulated sensors through all four stages: gates wide enough to be stable, too narrow for a broken sign."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from velod.cli.stages import true_depth_of
from velod.config import Settings
from velod.eval.front_end import FrontEnd
from velod.eval.metrics import Metrics, evaluate
from velod.eval.scene_truth import TrueDepth
from velod.eval.stage_errors import StageErrors, stage_errors
from velod.eval.stage_tables import as_json
from velod.geometry.calibration import Calibration
from velod.io import Recording, open_recording
from velod.runtime.offline import run_offline
from velod.types import DepthBatch, EventBatch, FlowBatch

SEQUENCES = {"corridor-1": 0.6, "boxes-4": 0.6}


@dataclass(frozen=True)
class Run:
    recording: Recording
    metrics: Metrics
    selected: list[EventBatch]
    flows: list[FlowBatch]
    depths: list[DepthBatch]
    true_depth: TrueDepth

    def stage_errors(self, calibration: Calibration | None = None) -> StageErrors:
        assert self.recording.truth is not None
        return stage_errors(
            calibration or self.recording.calibration, self.recording.truth, self.true_depth, Settings().depth,
            self.selected, self.flows, self.depths,
        )  # fmt: skip


@pytest.fixture(scope="module", params=SEQUENCES)
def run(request: pytest.FixtureRequest, simulated: Callable[[str, float], Path]) -> Run:
    path = simulated(request.param, SEQUENCES[request.param])
    recording = open_recording(path)
    kept = FrontEnd()
    velocities = run_offline(Settings(), recording.calibration, recording.packets(), kept.note)
    true_depth = true_depth_of(recording)
    assert recording.truth is not None and true_depth is not None
    metrics = evaluate(velocities, recording.truth, recording.t_start_ns)
    return Run(recording, metrics, kept.selected, kept.flows, kept.depths, true_depth)


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
    errors = run.stage_errors().flow
    assert errors.n > 5000
    assert abs(errors.bias) < 0.01
    assert errors.spread < 0.045
    assert errors.outliers < 0.01
    assert 0.4 < errors.sigmas < 1.6


def test_disparity_is_right_and_its_sigma_honest(run: Run) -> None:
    errors = run.stage_errors()
    assert errors.depth.n > 5000
    assert abs(errors.depth.bias_px) < 0.04
    assert errors.depth.mad_px < 0.12
    assert errors.depth.wrong < 0.02
    assert 0.5 < errors.depth.sigmas < 1.6
    assert errors.refined_depth.mad_px < errors.block_depth.mad_px


def test_the_judge_of_the_stages_sees_a_wrong_baseline_and_a_shifted_disparity(run: Run) -> None:
    calibration = run.recording.calibration
    wider = replace(calibration, t_RL=1.05 * calibration.t_RL)
    assert run.stage_errors(wider).depth.bias_px < -0.25
    shifted = [replace(batch, disparity=batch.disparity + np.float32(0.5)) for batch in run.depths]
    assert replace(run, depths=shifted).stage_errors().depth.bias_px == pytest.approx(0.5, abs=0.04)
    faster = [replace(batch, speed=1.1 * batch.speed) for batch in run.flows]
    assert replace(run, flows=faster).stage_errors().flow.bias == pytest.approx(0.1, abs=0.012)


def test_stamps_that_are_late_are_found_from_the_change_of_the_flow(run: Run) -> None:
    """Under three of its own errors without; of two milliseconds all, but for what the edge does meanwhile."""
    flow = run.stage_errors().flow
    assert abs(flow.late_s) < 3.0 * flow.late_se_s + 3e-4
    late = [replace(batch, t_ns=batch.t_ns + 2_000_000) for batch in run.selected]
    assert replace(run, selected=late).stage_errors().flow.late_s - flow.late_s == pytest.approx(2e-3, rel=0.15)


def test_groups_hold_every_event_once(run: Run) -> None:
    errors = run.stage_errors()
    for what in ("distance", "polarity"):
        assert sum(group.flow.n for group in errors.groups[what]) == errors.flow.n, what
        assert sum(group.depth.n for group in errors.groups[what]) == errors.depth.n, what
    assert sum(group.flow.n for group in errors.groups["flow"]) == errors.flow.n
    assert sum(group.flow.n for group in errors.groups["edge direction, |n_x|"]) == errors.flow.n


def test_a_batch_without_a_flow_or_a_depth_is_judged_like_one_that_is_missing(run: Run) -> None:
    def emptied(batch: FlowBatch | DepthBatch, columns: tuple[str, ...]) -> Any:
        return replace(batch, **{c: getattr(batch, c)[:0] for c in columns})

    flows = [emptied(run.flows[0], ("index", "age", "x", "y", "n", "speed", "sigma")), *run.flows[1:]]
    depths = [emptied(run.depths[0], ("index", "disparity", "inv_depth", "sigma", "refined")), *run.depths[1:]]
    without = replace(run, flows=run.flows[1:], depths=run.depths[1:]).stage_errors()
    assert as_json(replace(run, flows=flows, depths=depths).stage_errors()) == as_json(without)


def test_a_depth_that_is_missing_lowers_the_share_of_events_with_a_depth(run: Run) -> None:
    errors = run.stage_errors()
    assert errors.with_depth < errors.with_depth_where_possible < 1.0
    halved = [
        replace(b, **{c: getattr(b, c)[::2] for c in ("index", "disparity", "inv_depth", "sigma", "refined")})
        for b in run.depths
    ]
    assert replace(run, depths=halved).stage_errors().with_depth == pytest.approx(errors.with_depth / 2, rel=0.02)
