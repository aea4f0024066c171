"""A 640x480 pair, simulated: nothing is set, and the velocity is as right as a DAVIS346's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from velod.config import Settings
from velod.eval.metrics import evaluate
from velod.io import open_recording
from velod.runtime.offline import run_offline
from velod.sim import sequence
from velod.sim.run import simulate
from velod.types import EventBatch, Message


def test_a_640x480_pair_is_measured_with_the_defaults(tmp_path: Path) -> None:
    simulate(replace(sequence("boxes-4"), sensor=(640, 480)), 0.3, 1, tmp_path / "vga.h5")
    recording = open_recording(tmp_path / "vga.h5")
    assert (recording.calibration.left.width, recording.calibration.left.height) == (640, 480)
    selected: list[int] = []

    def note(message: Message) -> None:
        if isinstance(message, EventBatch):
            selected.append(len(message.x))

    velocities = run_offline(Settings(), recording.calibration, recording.packets(), note)
    # A DAVIS346 selects 500 at the most.
    assert np.median(selected) > 700
    assert recording.truth is not None
    metrics = evaluate(velocities, recording.truth, recording.t_start_ns)
    assert metrics.n > 15
    assert metrics.ave_mps < 0.08  # measured 0.026 over a second; this is mostly start-up
