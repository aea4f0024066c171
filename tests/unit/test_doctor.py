"""``velod doctor``: a line for each thing, and what to do about it."""

from __future__ import annotations

import json
import os
import socket
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from velod.cli import main
from velod.config import DepthSettings, Settings, ZenohSettings
from velod.geometry.calibration_files import save_calibration
from velod.prove.besieged import free_port
from velod.runtime import checkup
from velod.runtime.certificates import make_keys
from velod.runtime.kernel_cache import confirm_kernels
from velod.runtime.session import open_session
from velod.runtime.settings_service import serve
from velod.runtime.warmup import plain_calibration


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def settings_file(tmp_path: Path, port: int) -> Path:
    save_calibration(tmp_path / "rig.yaml", plain_calibration())
    path = tmp_path / "velod.toml"
    path.write_text(f'[rig]\ncalibration = "{tmp_path}/rig.yaml"\n[zenoh]\nport = {port}\n')
    return path


def test_an_installation_that_works_has_no_failures(
    settings_file: Path, port: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", "-c", str(settings_file), "--json", "-"]) == 0
    captured = capsys.readouterr()
    findings = {f["name"]: f for f in json.loads(captured.out)}
    assert all(f["state"] in ("OK", "WARN") for f in findings.values())
    assert {"python", "packages", "kernels", "processors", "memory", "shared memory", "clock"} <= set(findings)
    assert findings["calibration"]["state"] == "OK"
    assert "baseline 100.0 mm, depth from 0.48 m on" in findings["calibration"]["found"]  # 230 px 0.1 m / 48 px
    assert findings["service"]["found"] == f"none is running; port {port} is free for one"
    assert len(captured.err.splitlines()) >= len(findings)


def test_whatever_is_not_well_comes_with_what_to_do(settings_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["doctor", "-c", str(settings_file), "--json", "-"])
    for finding in json.loads(capsys.readouterr().out):
        assert bool(finding["advice"]) == (finding["state"] != "OK"), finding


def test_a_port_that_another_program_has_fails(
    settings_file: Path, port: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("velod.runtime.settings_service.ANSWER_S", 0.2)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        assert main(["doctor", "-c", str(settings_file)]) == 1
    assert "another program has the port" in capsys.readouterr().out


def test_settings_that_velod_would_not_take_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "velod.toml").write_text("[zenoh]\nport = 0\n")
    assert main(["doctor", "-c", str(tmp_path / "velod.toml")]) == 2
    assert "zenoh.port" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "doubt"),
    [
        ({"t_RL": np.array([-100.0, 0.0, 0.0])}, "a baseline of 100 m"),
        ({"T_cam_imu": np.array([[1.0, 0, 0, 60], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])}, "an IMU 60 m from"),
        ({"left": replace(plain_calibration().left, cx=20.0)}, "left: principal point"),
        ({"left": replace(plain_calibration().left, fx=3000.0, fy=3000.0)}, "left: a focal length of 3000 px"),
    ],
)
def test_a_calibration_unlike_a_stereo_cameras_is_doubted(
    tmp_path: Path, changes: dict[str, object], doubt: str
) -> None:
    save_calibration(tmp_path / "rig.yaml", replace(plain_calibration(), **changes))
    finding = checkup.calibration(str(tmp_path / "rig.yaml"), DepthSettings())
    assert finding.state == "WARN"
    assert doubt in finding.found


def test_a_calibration_that_cannot_be_read_fails_and_none_is_a_warning(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("left: 3\n")
    assert checkup.calibration(str(tmp_path / "rig.yaml"), DepthSettings()).state == "FAIL"
    assert checkup.calibration(str(tmp_path / "none.yaml"), DepthSettings()).state == "FAIL"
    assert checkup.calibration("", DepthSettings()).state == "WARN"


def test_certificates_are_judged_by_what_is_left_of_them(tmp_path: Path) -> None:
    make_keys(tmp_path / "fresh", days=365.0)
    make_keys(tmp_path / "late", days=10.0)
    (tmp_path / "late" / "driver.key").unlink()
    fresh = {f.name: f for f in checkup.certificates(str(tmp_path / "fresh"), "rig0")}
    late = {f.name: f for f in checkup.certificates(str(tmp_path / "late"), "rig0")}
    assert len(fresh) == 5 and all(f.state == "OK" for f in fresh.values())
    assert late["certificate driver"].state == "FAIL"
    assert late["certificate worker"].state == "WARN" and "good for 10 days" in late["certificate worker"].found
    assert checkup.certificates(str(tmp_path), "rig0")[0].state == "FAIL"
    assert checkup.certificates("", "rig0") == []


def test_kernels_that_were_never_compiled_are_a_warning_and_a_closed_folder_a_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert checkup.kernels().state == "WARN"
    (tmp_path / "plane_fit.fit-1.py311.nbi").touch()
    assert checkup.kernels().state == "OK"
    os.utime(tmp_path / "plane_fit.fit-1.py311.nbi", (0.0, 0.0))
    assert "older than their source: plane_fit" in checkup.kernels().found
    confirm_kernels()  # as warming up does
    assert checkup.kernels().state == "OK"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "none"))
    assert checkup.kernels().state == "FAIL"


def test_too_little_memory_is_a_warning(tmp_path: Path) -> None:
    (tmp_path / "meminfo").write_text("MemTotal: 4000000 kB\nMemAvailable:  512000 kB\n")
    assert checkup.memory(tmp_path / "meminfo").state == "WARN"
    assert checkup.shared_memory(tmp_path / "none").state == "WARN"


def test_a_place_that_was_named_has_to_answer(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("velod.runtime.settings_service.ANSWER_S", 0.2)
    there = ZenohSettings(connect=f"tcp/127.0.0.1:{port}")
    finding = checkup.service("rig0", there, expected=True)
    assert finding.state == "FAIL" and "no velod serves rig 'rig0'" in finding.found


def test_a_velod_that_answers_is_good(port: int) -> None:
    with (
        open_session(ZenohSettings(port=port), introducer=True) as session,
        serve(session, Settings(), plain_calibration()),
    ):
        finding = checkup.service("rig0", ZenohSettings(port, connect=f"tcp/127.0.0.1:{port}"), expected=True)
    assert (finding.state, finding.found) == ("OK", f"rig rig0 answers at tcp/127.0.0.1:{port}")
