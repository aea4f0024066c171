"""The command line with real processes: results, signals, and a port that is taken."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest

from tests import slanted_scene
from velod.cli import main
from velod.geometry.calibration_files import save_calibration

pytestmark = pytest.mark.system
VELOD = [sys.executable, "-P", "-m", "velod.cli"]


@pytest.fixture
def settings_file(tmp_path: Path, port: int) -> Path:
    path = tmp_path / "velod.toml"
    path.write_text(f"[zenoh]\nport = {port}\n")
    return path


def children_of(pid: int) -> set[int]:
    """Process ids of all children, alive now."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return {int(child) for task in tasks for child in task.read_text().split()}


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_eval_through_the_processes_knows_the_latency(slanted: Path, settings_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    assert main(["eval", str(slanted), "-c", str(settings_file), "--speed", "max", "--json", str(out)]) == 0
    result = json.loads(out.read_text())
    assert result["ave_mps"] < 0.5 and result["valid_fraction"] > 0.9 and result["real_time_factor"] > 0.0
    assert 0.0 < result["latency_p50_ms"] <= result["latency_p99_ms"]


@pytest.fixture
def uncalibrated(tmp_path: Path) -> tuple[Path, Path]:
    """A recording without a calibration of its own, and the file that holds it."""
    recording = slanted_scene.write(tmp_path / "uncalibrated.h5", 0.6)
    with h5py.File(recording, "a") as file:
        del file["calib"]
    save_calibration(tmp_path / "rig.yaml", slanted_scene.RIG)
    return recording, tmp_path / "rig.yaml"


@pytest.mark.parametrize("where", ["option", "settings"])
def test_a_recording_without_a_calibration_is_played_with_the_one_that_is_named(
    where: str, uncalibrated: tuple[Path, Path], settings_file: Path, tmp_path: Path
) -> None:
    recording, rig = uncalibrated
    out = tmp_path / "out.json"
    argv = ["eval", str(recording), "-c", str(settings_file), "--speed", "max", "--json", str(out)]
    if where == "option":
        argv += ["--calibration", str(rig)]
    else:
        settings_file.write_text(f'{settings_file.read_text()}[rig]\ncalibration = "{rig}"\n')
    assert main(argv) == 0
    result = json.loads(out.read_text())
    assert result["ave_mps"] < 0.5 and result["valid_fraction"] > 0.9


@pytest.mark.timed
def test_the_demo_ends_with_its_error_against_the_truth(
    simulated: Callable[[str, float], Path],
    settings_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("VELOD_CACHE_DIR", str(simulated("boxes-4", 0.6).parents[1]))
    out = tmp_path / "out.json"
    argv = ["demo", "--seconds", "0.6", "--sequence", "boxes-4", "-c", str(settings_file), "--json", str(out)]
    assert main(argv) == 0
    assert json.loads(out.read_text())["ave_mps"] < 0.1
    shown = capsys.readouterr()
    assert all(word in shown.out for word in ("AVE", "RVE", "rate", "latency", "dropped        nothing"))
    assert "0.6 s of boxes-4 in real time" in shown.err and "simulating" not in shown.err, "it was kept"


def test_a_port_that_is_taken_is_one_clear_line(slanted: Path, tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        settings = tmp_path / "velod.toml"
        settings.write_text(f"[zenoh]\nport = {port}\n")
        done = subprocess.run(
            [*VELOD, "replay", str(slanted), "-c", str(settings)], capture_output=True, text=True, timeout=60
        )
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(f"velod: error: port {port} is already in use")
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="looks for child processes in /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_replay_and_all_its_processes(
    number: signal.Signals, slanted: Path, settings_file: Path
) -> None:
    with subprocess.Popen(
        [*VELOD, "replay", str(slanted), "-c", str(settings_file), "--speed", "0.05"],
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            deadline_s = time.monotonic() + 60.0
            # Four workers, the spare and the driver.
            while len(seen := children_of(process.pid)) < 6 and time.monotonic() < deadline_s:
                time.sleep(0.05)
            assert len(seen) >= 6
            os.kill(process.pid, number)
            _, errors = process.communicate(timeout=20)
        finally:
            process.kill()
    assert process.returncode == 130
    assert errors.splitlines()[-1] == "velod: interrupted" and "Traceback" not in errors
    assert not any(is_alive(pid) for pid in seen)
