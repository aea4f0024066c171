"""Flow and disparity where sensors are at their worst, and with batches of any length, against the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest

from velod.cli.stages import true_depth_of
from velod.config import Settings, from_tree
from velod.depth.stage import DepthStage
from velod.eval.front_end import FrontEnd
from velod.eval.metrics import evaluate
from velod.eval.scene_truth import TrueDepth
from velod.eval.stage_errors import FlowErrors, StageErrors, stage_errors
from velod.io import Recording, open_recording
from velod.runtime.offline import run_front_end, run_offline
from velod.sim import Sequence, sequence, simulate
from velod.types import DepthBatch, EventBatch, FlowBatch, Message, StereoBatch

Record = Callable[[Sequence, float], Recording]


@dataclass(frozen=True)
class Judged:
    """What flow and depth made of a recording, and its truth."""

    recording: Recording
    true_depth: TrueDepth
    selected: list[EventBatch]
    flows: list[FlowBatch]
    depths: list[DepthBatch]

    def errors_of(self, depths: list[DepthBatch]) -> StageErrors:
        """Of these flows, and of the depths given."""
        assert self.recording.truth is not None
        return stage_errors(
            self.recording.calibration, self.recording.truth, self.true_depth, Settings().depth,
            self.selected, self.flows, depths,
        )  # fmt: skip

    @cached_property
    def flow(self) -> FlowErrors:
        return self.errors_of(self.depths).flow


def judged(recording: Recording, settings: Settings, also: Callable[[Message], None] = lambda _: None) -> Judged:
    """The front end's run on a recording; ``also`` sees every message as well."""
    kept, true_depth = FrontEnd(), true_depth_of(recording)
    assert true_depth is not None

    def note(message: Message) -> None:
        kept.note(message)
        also(message)

    run_front_end(settings, recording.calibration, recording.packets(), note)
    return Judged(recording, true_depth, kept.selected, kept.flows, kept.depths)


def assert_within(flow: FlowErrors, n: int, bias: float, spread: float, outliers: float) -> None:
    """More than ``n`` flows; the others are limits, as shares."""
    assert flow.n > n
    assert abs(flow.bias) < bias
    assert flow.spread < spread
    assert flow.outliers < outliers


@pytest.fixture
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """Simulate a recipe for so many seconds."""

    def make(recipe: Sequence, seconds: float) -> Recording:
        path = tmp_path_factory.mktemp("limits") / f"{recipe.name}.h5"
        simulate(recipe, seconds, 1, path)
        return open_recording(path)

    return make


def test_a_low_contrast_threshold_spoils_no_flow(record: Record) -> None:
    """At 0.15 an edge fires three times as many events a pixel; the first of each burst counts."""
    recipe = sequence("boxes-4")
    recipe = replace(recipe, events=replace(recipe.events, threshold=0.15))
    flow = judged(record(recipe, 0.12), Settings()).flow
    assert_within(flow, n=2000, bias=0.005, spread=0.03, outliers=0.005)


def test_mismatch_jitter_and_noise_together_leave_the_flow_within_five_percent(record: Record) -> None:
    """Thresholds 5 % apart, stamps off by 0.5 ms, 5 background events a second at every pixel."""
    recipe = sequence("boxes-4")
    effects = replace(recipe.effects, jitter_us=500.0, noise_hz=5.0)
    recipe = replace(recipe, effects=effects, events=replace(recipe.events, threshold_sigma=0.05))
    flow = judged(record(recipe, 0.35), Settings()).flow
    assert_within(flow, n=2500, bias=0.01, spread=0.05, outliers=0.015)


def test_half_a_millisecond_of_jitter_leaves_the_velocity_of_a_spin(record: Record) -> None:
    """Half a pixel beyond 1000 px/s: gates that do not know of it made the flow 3 % slow, and no velocity valid."""
    recipe = sequence("spin-1")
    recording = record(replace(recipe, effects=replace(recipe.effects, jitter_us=500.0)), 0.5)
    kept = FrontEnd()
    velocities = run_offline(Settings(), recording.calibration, recording.packets(), kept.note)
    noise_us = [1e-3 * batch.time_noise_ns for batch in kept.selected]
    assert 350.0 < noise_us[-1] < 600.0
    assert recording.truth is not None
    metrics = evaluate(velocities, recording.truth, recording.t_start_ns)
    assert metrics.first_valid_s < 0.45
    assert metrics.valid_fraction == 1.0
    # 5 % of the speed; 0.07 was measured
    assert metrics.ave_mps < 0.12


@pytest.fixture(scope="module")
def plain(simulated: Callable[[str, float], Path]) -> Recording:
    """Sensors without faults."""
    return open_recording(simulated("boxes-4", 0.6))


def test_the_bias_of_the_flow_does_not_depend_on_the_length_of_the_batch(plain: Recording) -> None:
    """The neighbours' memory is the same for both: 5 ms, and 45,000 events (4 to 5 times as long here)."""
    short = judged(plain, from_tree({"ingest": {"batch": "time", "period_ms": 5.0}}))
    long = judged(plain, from_tree({"ingest": {"batch": "count", "count": 45_000}}))
    lengths_ns = [np.median(np.diff([f.t_ns for f in run.flows])) for run in (short, long)]
    assert lengths_ns[0] == 5e6 and lengths_ns[1] > 10e6
    assert abs(short.flow.bias - long.flow.bias) < 0.003
    assert all(run.flow.n > 3000 for run in (short, long))


def test_refined_disparities_are_four_times_better_than_block_matching_of_the_same_events(plain: Recording) -> None:
    """4.4 times on the first seconds of boxes-4: 0.037 and 0.161 px, and without the bias of 0.08 px."""
    by_blocks = DepthStage(from_tree({"depth": {"refine": False, "block_only": "all"}}), plain.calibration)
    blocks: dict[int, DepthBatch] = {}

    def match_blocks(message: Message) -> None:
        if isinstance(message, StereoBatch):
            blocks.update({batch.seq: batch for batch in by_blocks.handle(message)})

    run = judged(plain, Settings(), match_blocks)
    both = [(own, np.intersect1d(own.index[own.refined == 1], blocks[own.seq].index)) for own in run.depths]
    refined = run.errors_of([at(own, index) for own, index in both]).depth
    block = run.errors_of([at(blocks[own.seq], index) for own, index in both]).depth
    assert refined.n == block.n > 5000
    assert abs(refined.bias_px) < 0.01
    assert refined.mad_px < 0.06
    assert block.mad_px > 4.0 * refined.mad_px


def at(batch: DepthBatch, index: np.ndarray) -> DepthBatch:
    """The depths of the events ``index``."""
    rows = np.isin(batch.index, index)
    columns = ("index", "disparity", "inv_depth", "sigma", "refined")
    return replace(batch, **{name: getattr(batch, name)[rows] for name in columns})
