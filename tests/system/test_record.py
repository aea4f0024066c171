"""``velod record`` beside a velod at work: what was recorded plays again, and gives the same velocities."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests import slanted_scene
from velod.cli import main
from velod.config import Settings
from velod.io import open_recording
from velod.runtime.offline import run_offline

pytestmark = pytest.mark.system
VELOD = [sys.executable, "-P", "-m", "velod.cli"]


@pytest.mark.timed
def test_the_sensors_and_the_velocity_of_a_replay_are_recorded_whole(port: int, tmp_path: Path) -> None:
    # At half speed: what is shown is that nothing is lost on a machine that can follow.
    slanted = slanted_scene.write(tmp_path / "slanted.h5", 2.5)
    settings = tmp_path / "velod.toml"
    settings.write_text(f"[zenoh]\nport = {port}\n")
    configured = ["-c", str(settings)]
    with subprocess.Popen(
        [*VELOD, "replay", str(slanted), "--speed", "0.5", *configured], stderr=subprocess.DEVNULL
    ) as replay:
        time.sleep(1.0)
        recorders = [
            subprocess.Popen([*VELOD, "record", str(tmp_path / name), *configured], stderr=subprocess.PIPE, text=True)
            for name in ("run.h5", "run.mcap")
        ]
        assert replay.wait(120.0) == 0
        for recorder in recorders:
            recorder.send_signal(signal.SIGINT)
        said = [recorder.communicate(timeout=30.0)[1] for recorder in recorders]
    assert [recorder.returncode for recorder in recorders] == [0, 0], said

    original, again = open_recording(slanted), open_recording(tmp_path / "run.h5")
    assert again.n_events == original.n_events
    velocities = [run_offline(Settings(), r.calibration, r.packets()) for r in (original, again)]
    assert [v.v_B.tolist() for v in velocities[0]] == [v.v_B.tolist() for v in velocities[1]]

    with (tmp_path / "run.mcap").open("rb") as file:
        stored = [(channel.topic, json.loads(m.data)) for _, channel, m in make_reader(file).iter_messages()]
    times = [v["t_ns"] for topic, v in stored if topic == "velod/rig0/velocity"]
    assert times == sorted(set(times)) and len(times) >= 0.99 * len(velocities[0])
    assert {v["stage"] for topic, v in stored if "health" in topic} >= {"ingest", "flow", "depth", "optimizer"}


def test_a_rig_that_sends_nothing_leaves_no_file(port: int, tmp_path: Path) -> None:
    with subprocess.Popen(
        [*VELOD, "record", str(tmp_path / "run.mcap"), "--connect", f"tcp/127.0.0.1:{port}"],
        stderr=subprocess.PIPE,
        text=True,
    ) as recorder:
        assert recorder.stderr is not None
        assert recorder.stderr.readline().startswith("recording rig rig0")
        recorder.send_signal(signal.SIGTERM)
        _, said = recorder.communicate(timeout=20.0)
    assert recorder.returncode == 1
    assert said.startswith("velod: failed: nothing came from rig rig0")
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.parametrize(
    ("argv", "why"),
    [
        (["run.txt"], "must end in .h5"),
        (["run.h5", "velocity"], "topics go with .mcap"),
        (["run.mcap", "velocities"], "no topic 'velocities' to record"),
        (["taken.mcap"], "exists already"),
    ],
)
def test_what_cannot_be_recorded_is_one_clear_line(
    argv: list[str], why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken.mcap").touch()
    assert main(["record", *argv]) == 2
    assert why in capsys.readouterr().err
