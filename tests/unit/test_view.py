"""``velod view`` without a window: what it writes for the Rerun viewer. Skipped where the extra 'view' is missing."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import synthetic
from velod.cli.view import Scene, keep_to_ourselves
from velod.config import Settings
from velod.optimizer.stage import OptimizerStage
from velod.types import DepthBatch, EventBatch, FlowBatch, ImuSamples, Velocity

pytest.importorskip("rerun", reason="needs rerun-sdk: pip install 'velod[view]'")


class Kept:
    """A recording that keeps what is logged, by entity."""

    def __init__(self) -> None:
        self.logged: dict[str, list[Any]] = {}
        self.t_s: list[float] = []

    def set_time(self, timeline: str, *, duration: float) -> None:
        assert timeline == "sensor"
        self.t_s.append(duration)

    def log(self, entity: str, what: Any, static: bool = False) -> None:
        self.logged.setdefault(entity, []).append(what)


def shown() -> list[Any]:
    """A second of flow, depth and velocities, and a batch of events."""
    stage = OptimizerStage(Settings(), synthetic.CALIBRATION)
    out: list[Any] = []
    for message in synthetic.messages(synthetic.FLIGHT, 1.0):
        out += [] if isinstance(message, ImuSamples) else [message]
        out += stage.handle(message)
    n = 7
    column = np.arange(n, dtype=np.uint16)
    ages, patch = np.ones(n, np.uint32), np.ones((n, 25), np.uint32)
    return [*out, EventBatch(0, 5, 0, n, column, column, ages, (column % 2).astype(np.uint8), patch)]


def test_everything_that_is_shown_is_logged_once_at_its_sensor_time() -> None:
    kept, messages = Kept(), shown()
    scene = Scene(kept)
    for message in messages:
        scene.log(message)
    count = {kind: sum(isinstance(m, kind) for m in messages) for kind in (FlowBatch, DepthBatch, EventBatch)}
    valid = [m for m in messages if isinstance(m, Velocity) and m.valid]
    assert len(kept.logged["image/flow"]) == count[FlowBatch] > 50
    assert len(kept.logged["image/depth"]) == count[DepthBatch] == count[FlowBatch]
    assert len(kept.logged["image/events"]) == 1
    assert len(kept.logged["path"]) > 50
    # The first of each axis is its style.
    assert [len(kept.logged[f"velocity/{axis}"]) for axis in "xyz"] == [len(valid) + 1] * 3
    assert kept.t_s == pytest.approx([m.t_ns * 1e-9 for m in messages])


def test_velocities_have_a_band_of_three_sigmas() -> None:
    kept = Kept()
    velocity = Velocity(0, 10, np.array([1.0, 2.0, 3.0]), np.diag([0.01, 0.04, 0.09]), True, "tracking", "", 0, 0)
    Scene(kept).log(velocity)
    bands = [kept.logged[f"velocity/{axis}"][1].scalars.as_arrow_array().to_pylist() for axis in "xyz"]
    np.testing.assert_allclose(bands, [[1.0, 0.7, 1.3], [2.0, 1.4, 2.6], [3.0, 2.1, 3.9]])


def test_a_file_is_written_that_the_viewer_takes_and_rerun_s_analytics_are_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    keep_to_ourselves()
    import rerun

    recording, path = rerun.RecordingStream("velod"), tmp_path / "run.rrd"
    recording.save(path)
    scene = Scene(recording)
    for message in shown():
        scene.log(message)
    recording.flush()
    recording.disconnect()
    verified = subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", path], capture_output=True, text=True)
    assert verified.returncode == 0, verified.stderr
    settings = json.loads(Path(os.environ["XDG_CONFIG_HOME"], "rerun", "analytics.json").read_text())
    assert settings["analytics_enabled"] is False
