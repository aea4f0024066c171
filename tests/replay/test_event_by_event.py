"""Event-by-event mode on simulated sensors: flow within 6 %, and velocities as good as those of batches."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from velod.cli import main
from velod.cli.stages import true_depth_of
from velod.config import from_tree
from velod.eval.front_end import FrontEnd
from velod.eval.metrics import evaluate
from velod.eval.stage_errors import stage_errors
from velod.io import open_recording
from velod.runtime.offline import run_offline
from velod.types import DepthBatch


def test_flow_and_velocity_hold_without_batches_to_wait_for(simulated: Callable[[str, float], Path]) -> None:
    recording = open_recording(simulated("corridor-1", 0.6))
    settings, kept = from_tree({"ingest": {"mode": "event"}}), FrontEnd()
    velocities = run_offline(settings, recording.calibration, recording.packets(), kept.note)
    true_depth = true_depth_of(recording)
    assert recording.truth is not None and true_depth is not None
    assert len(kept.flows) > 8 * len([m for m in kept.messages if isinstance(m, DepthBatch)])
    errors = stage_errors(
        recording.calibration, recording.truth, true_depth, settings.depth, kept.selected, kept.flows, kept.depths
    )
    assert errors.flow.n > 5000
    assert abs(errors.flow.bias) < 0.01
    assert errors.flow.spread < 0.06
    assert errors.flow.outliers < 0.01
    assert errors.with_depth > 0.5
    assert abs(errors.depth.bias_px) < 0.04
    # The bounds on batches, see test_accuracy.
    metrics = evaluate(velocities, recording.truth, recording.t_start_ns)
    assert metrics.ave_mps < 0.12
    assert metrics.valid_fraction == 1.0


def test_the_stages_are_judged_by_command_in_this_mode_too(
    simulated: Callable[[str, float], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "event.toml"
    config.write_text('[ingest]\nmode = "event"\n')
    found = {}
    for mode, chosen in (("event", ["-c", str(config)]), ("batch", [])):
        out = tmp_path / f"{mode}.json"
        recording = str(simulated("corridor-1", 0.6))
        assert main(["eval", recording, *chosen, "--stages", "--json", str(out)]) == 0
        assert "Normal flow against the truth" in capsys.readouterr().out
        found[mode] = json.loads(out.read_text())
    # The same events' truth; a causal neighbourhood holds the past half only, and so scatters more.
    assert found["batch"]["flow"]["spread"] < found["event"]["flow"]["spread"] < 0.06
    assert abs(found["event"]["flow"]["bias"]) < 0.01
