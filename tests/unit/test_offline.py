"""The four stages in one process."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests import slanted_scene
from velod.config import Settings
from velod.io import open_recording
from velod.runtime.offline import run_offline
from velod.types import DepthBatch, EventBatch, FlowBatch, ImuSamples, Message, Odometry, StereoBatch, Velocity


def test_a_recording_runs_through_all_stages_to_the_true_velocity_and_again_to_the_same_bits(tmp_path: Path) -> None:
    recording = open_recording(slanted_scene.write(tmp_path / "scene.h5", 1.0))
    seen: list[Message] = []
    counters: dict[str, dict[str, int]] = {}
    velocities = run_offline(Settings(), recording.calibration, recording.packets(), seen.append, counters)
    assert {type(m) for m in seen} == {EventBatch, StereoBatch, ImuSamples, FlowBatch, DepthBatch, Velocity, Odometry}
    assert [m for m in seen if isinstance(m, Velocity)] == velocities
    assert counters["ingest"]["batches"] == sum(isinstance(m, EventBatch) for m in seen) > 40
    errors = [np.linalg.norm(v.v_B - slanted_scene.V_B) for v in velocities if v.valid]
    assert len(errors) > 50
    assert np.median(errors) < 0.1
    again = run_offline(Settings(), recording.calibration, recording.packets())
    assert [v.v_B.tobytes() for v in again] == [v.v_B.tobytes() for v in velocities]
