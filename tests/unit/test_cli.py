"""What people type: results in the documented form, and one clear line for everything that is wrong."""

from __future__ import annotations

import csv
import json
import re
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable
from io import BytesIO, TextIOWrapper
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests import slanted_scene
from velod import config
from velod.cli import main
from velod.config import Settings
from velod.eval.metrics import truth_at
from velod.geometry.calibration_files import load_calibration, save_calibration
from velod.io import open_recording
from velod.sim import Sequence

COMMANDS = ("demo", "run", "replay", "eval", "sim", "echo", "top", "config", "bench", "warmup", "doctor", "record")
EVAL_KEYS = [
    *("ave_mps", "rve_percent", "p95_mps", "n", "first_valid_s", "valid_fraction", "ave_floor_mps", "nees_mean"),
    *("drift_percent", "real_time_factor", "latency_p50_ms", "latency_p99_ms", "median_mps", "rve_median_percent"),
    *("rve_p95_percent", "within_1_sigma", "within_2_sigma", "within_3_sigma"),
]
EXAMPLE_RIG = str(Path(__file__).parents[2] / "examples" / "rig.yaml")
CSV_HEADER = (
    "t_ns,vx,vy,vz,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz,state,valid,age_ms,"
    "bridged_ms,up_x,up_y,up_z,up_sigma,frame,degenerate"
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return slanted_scene.write(tmp_path_factory.mktemp("cli") / "slanted.h5", 0.6)


def error_of(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """The one line that a command which must fail with 2 writes to stderr."""
    assert main(argv) == 2
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert captured.out == "" and len(lines) == 1 and lines[0].startswith("velod: error: ")
    return lines[0].removeprefix("velod: error: ")


def refused_by_parser(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    with pytest.raises(SystemExit) as caught:
        main(argv)
    assert caught.value.code == 2
    return capsys.readouterr().err


# --- help ---


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_teaches_with_examples_of_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    text = capsys.readouterr().out
    assert caught.value.code == 0
    assert f"velod {command}" in text.split("examples:\n")[1]


def test_help_is_at_hand_without_loading_anything_heavy() -> None:
    code = (
        "import sys; from velod.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "print([m for m in ('numpy', 'numba', 'zenoh', 'scipy', 'cv2') if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"
    assert all(f"    {command} " in done.stdout for command in COMMANDS)


# --- what is wrong ---


def test_a_missing_settings_file_is_named(capsys: pytest.CaptureFixture[str], recording: Path) -> None:
    assert error_of(capsys, "run", "-c", "nowhere.toml") == "nowhere.toml: no such file"
    assert error_of(capsys, "replay", str(recording), "-c", "nowhere.toml") == "nowhere.toml: no such file"


def test_a_wrong_setting_is_named_with_file_key_and_reason(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "velod.toml"
    path.write_text("[flow]\nworkers = 0\n")
    for argv in (["config", "check", str(path)], ["run", "-c", str(path)], ["demo", "-c", str(path)]):
        assert error_of(capsys, *argv) == f"{path}: flow.workers: must be at least 1, got 0"


def test_a_missing_recording_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert error_of(capsys, "eval", "nowhere.h5", "--offline") == "nowhere.h5: no such file or directory"


def test_a_truncated_recording_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path, recording: Path) -> None:
    path = tmp_path / "cut.h5"
    path.write_bytes(recording.read_bytes()[:5000])
    assert "cut.h5" in error_of(capsys, "replay", str(path))


def test_a_recording_without_truth_cannot_be_judged(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, recording: Path
) -> None:
    path = tmp_path / "no_truth.h5"
    path.write_bytes(recording.read_bytes())
    with h5py.File(path, "a") as f:
        del f["gt"]
    assert "holds no truth" in error_of(capsys, "eval", str(path), "--offline")
    assert "holds no truth" in error_of(capsys, "eval", str(path), "--stages")


def test_a_recording_without_a_calibration_asks_for_one_and_takes_the_one_that_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, recording: Path
) -> None:
    path, rig = tmp_path / "bare.h5", tmp_path / "rig.yaml"
    path.write_bytes(recording.read_bytes())
    with h5py.File(path, "a") as f:
        del f["calib"]
    save_calibration(rig, slanted_scene.RIG)
    error = error_of(capsys, "replay", str(path), "--offline")
    assert error == f"{path}: no calibration (/calib is missing); name a file: --calibration FILE"
    assert error_of(capsys, "replay", str(path), "--calibration", "nowhere.yaml").startswith("nowhere.yaml: ")
    assert main(["replay", str(path), "--offline", "--calibration", str(rig)]) == 0


def test_a_calibration_that_cannot_be_read_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("left: {width: 346}\n")
    assert error_of(capsys, "config", "calibration", str(path)).startswith(f"{path}: ")
    settings = tmp_path / "velod.toml"
    settings.write_text(f'[rig]\ncalibration = "{path}"\n')
    assert error_of(capsys, "run", "-c", str(settings)).startswith(f"{path}: ")


def test_the_service_beside_a_sensor_needs_a_calibration(capsys: pytest.CaptureFixture[str]) -> None:
    assert "rig.calibration: missing" in error_of(capsys, "run")


def test_a_malformed_endpoint_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert "zenoh.connect" in error_of(capsys, "echo", "--connect", "rig:17447")
    assert error_of(capsys, "relay", "--to", "rig:17447").startswith("--to: must be an endpoint")


@pytest.mark.parametrize(
    ("argv", "cause"),
    [
        (["echo", "speed"], "no topic 'speed' to print; topics: events, "),
        (["echo", "alive"], "no topic 'alive' to print"),
        (["sim", "corridor-9", "-o", "x.h5"], "unknown sequence 'corridor-9'"),
        (["demo", "--sequence", "corridor-9"], "unknown sequence 'corridor-9'"),
    ],
)
def test_an_unknown_name_is_answered_with_the_known_ones(
    argv: list[str], cause: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(argv) == 2
    assert cause in capsys.readouterr().err


def test_a_malformed_packet_rate_is_named(capsys: pytest.CaptureFixture[str], recording: Path) -> None:
    assert "got 'often'" in error_of(capsys, "replay", str(recording), "--packets", "often")


@pytest.mark.parametrize(
    ("argv", "cause"),
    [
        (["replay", "x.h5", "--speed", "fast"], "not a number: 'fast'"),
        (["replay", "x.h5", "--speed", "-1"], "must be positive"),
        (["demo", "--seconds", "nan"], "must be positive"),
        (["run", "--only", "flow,stereo"], "no stage 'stereo'"),
        (["demo", "--seed", "-1"], "must be a whole number from 0 on, got '-1'"),
        (["sim", "corridor-1", "-o", "x.h5", "--texture", "1.5"], "must be a whole number from 0 on, got '1.5'"),
        (["echo", "-n", "0"], "must be a whole number from 1 on, got '0'"),
        (["router", "--port", "99999"], "must be a whole number from 1 to 65535, got '99999'"),
        (["config", "keys", "keys", "--days", "nan"], "must be positive"),
        (["config", "keys", "keys", "--rig", "../rig0"], "must be one part of a key"),
        (["config", "keys", "keys", "--host", "a/b"], "must be the name or address of a host"),
        (["config", "topology", "remote", "--max-hz", "-1"], "must be zero or more"),
        (["prove", "fleet", "--hz", "0"], "must be positive"),
        (["prove", "scaling", "--workers", "0"], "must be a whole number from 1 on"),
        (["record"], "the following arguments are required: FILE\n"),
        ([], "COMMAND"),
    ],
)
def test_a_value_that_cannot_be_is_refused_at_once(
    argv: list[str], cause: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cause in refused_by_parser(capsys, *argv)


def test_what_speaks_against_the_sensors_stands_below_the_summary(
    capsys: pytest.CaptureFixture[str], recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("velod.ingest.imu_units.LEAST_M_S2", 1000.0)
    monkeypatch.setattr("velod.ingest.imu_units.PERIOD_NS", 100_000_000)
    assert main(["replay", str(recording), "--offline"]) == 0
    assert "ALARM          imu.units: the accelerometer reads" in capsys.readouterr().out


def test_a_result_that_cannot_be_written_is_named(capsys: pytest.CaptureFixture[str], recording: Path) -> None:
    assert main(["replay", str(recording), "--offline", "--csv", "nowhere/out.csv"]) == 2
    assert capsys.readouterr().err == "velod: error: nowhere/out.csv: No such file or directory\n"


def test_a_result_that_cannot_be_written_is_named_before_the_work(capsys: pytest.CaptureFixture[str]) -> None:
    # The recording, which is not there either, is not looked at.
    commands = (["replay", "absent.h5", "--csv"], ["eval", "absent.h5", "--json"], ["demo", "--csv"])
    for argv in (*commands, ["bench", "--json"], ["prove", "fuzz", "--json"], ["doctor", "--json"]):
        assert error_of(capsys, *argv, "nowhere/out") == "nowhere/out: No such file or directory"
        assert error_of(capsys, *argv, "/") == "/: Is a directory"


def test_a_folder_or_page_that_cannot_be_written_is_named_before_the_work(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (taken := tmp_path / "taken").write_text("no table\n")
    for option in ("--plot", "--report"):
        assert error_of(capsys, "eval", "absent.h5", option, str(taken)) == f"{taken}: File exists"
    for argv in (["eval", "--table", "synthetic"], ["eval", "absent.h5"]):
        assert "there is no place for these tables" in error_of(capsys, *argv, "--markdown", str(taken))
    assert error_of(capsys, "record", "nowhere/run.h5") == "nowhere/run.h5: No such file or directory"


def test_a_simulation_of_no_time_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    error = error_of(capsys, "sim", "corridor-1", "-o", str(tmp_path / "a.h5"), "--seconds", "1e-9")
    assert error == "1e-09 s are less than a microsecond"


def test_a_folder_in_place_of_settings_or_a_file_that_is_no_text_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (binary := tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    assert error_of(capsys, "config", "check", str(tmp_path)) == f"{tmp_path}: cannot be read: Is a directory"
    for argv in (["config", "check", str(binary)], ["config", "calibration", str(binary)]):
        assert error_of(capsys, *argv) == f"{binary}: cannot be read: not text in UTF-8"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no device that is always full")
def test_a_full_disk_is_named_with_the_file(capsys: pytest.CaptureFixture[str], recording: Path) -> None:
    assert main(["replay", str(recording), "--offline", "--csv", "/dev/full"]) == 2
    captured = capsys.readouterr()
    assert captured.err == "velod: error: /dev/full: No space left on device\n"
    assert "median speed" in captured.out, "what was computed is not lost"


def test_checking_settings_looks_at_their_endpoints(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "velod.toml").write_text('[zenoh]\nlisten = "tcp/localhost"\n')
    error = error_of(capsys, "config", "check", str(tmp_path / "velod.toml"))
    assert error.startswith(f"{tmp_path / 'velod.toml'}: zenoh.listen: must be an endpoint")


def test_certificates_that_are_missing_or_of_no_use_are_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    settings, missing = tmp_path / "velod.toml", tmp_path / "keys"
    settings.write_text(f'[zenoh]\nport = 1\nkeys = "{missing}"\n')
    no_folder = f"{missing}: no such folder (zenoh.keys); `velod config keys` makes certificates"
    for argv in (["config", "check", str(settings)], ["router", "-c", str(settings)], ["echo", "-c", str(settings)]):
        assert error_of(capsys, *argv) == no_folder
    assert error_of(capsys, "run", "--calibration", EXAMPLE_RIG, "-c", str(settings)) == no_folder
    without_use = error_of(capsys, "run", "--calibration", EXAMPLE_RIG, "--keys", str(tmp_path))
    assert without_use == "--keys goes with a tls/ endpoint: zenoh.listen, or --connect"


def test_a_run_without_a_valid_velocity_fails_and_says_so(
    capsys: pytest.CaptureFixture[str], recording: Path, tmp_path: Path
) -> None:
    settings = tmp_path / "velod.toml"
    settings.write_text("[optimizer]\nmin_flows = 10000\n")
    out = tmp_path / "out.json"
    argv = ["eval", str(recording), "--offline", "-c", str(settings), "--json", str(out)]
    assert main(argv) == 1
    why = "initialising: 0 usable batches; the newest: "
    said = capsys.readouterr().err
    assert said.startswith(f"velod: failed: {recording}: no valid velocity ({why}") and said.count("\n") == 1
    assert json.loads(out.read_text())["ave_mps"] is None


def test_an_interrupt_while_a_command_is_loaded_is_no_traceback(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Finder:
        def find_spec(self, name: str, *_: object) -> None:
            if name == "velod.cli.entry":
                signal.raise_signal(signal.SIGINT)

    monkeypatch.delitem(sys.modules, "velod.cli.entry", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Finder(), *sys.meta_path])
    assert main(["--version"]) == 130
    assert capsys.readouterr().err == "velod: interrupted\n"


def test_nothing_is_loaded_before_an_interrupt_is_caught() -> None:
    listed = "import sys; before = set(sys.modules); import velod.cli; print(*sorted(set(sys.modules) - before))"
    loaded = subprocess.check_output([sys.executable, "-P", "-c", listed], text=True).split()
    assert set(loaded) <= {"velod", "velod.cli", "collections", "collections.abc"}


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_that_python_drops_ends_long_work_all_the_same(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Array:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)  # what is raised now is dropped

    shares = []

    def simulate(recipe: Sequence, seconds: float, seed: int, path: str, progress: Callable[[float], None]) -> None:
        arrays = [Array()]
        for share in (0.1, 0.2, 0.3):
            shares.append(share)
            progress(share)
            arrays.clear()

    monkeypatch.setattr("velod.sim.simulate", simulate)
    assert main(["sim", "corridor-1", "-o", str(tmp_path / "a.h5")]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "velod: interrupted"
    assert shares == [0.1, 0.2]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no device that is always full")
@pytest.mark.parametrize(
    ("where", "code", "said"), [(">&-", 0, ""), (">/dev/full", 2, "velod: error: No space left on device\n")]
)
def test_nowhere_to_write_to_is_no_traceback(where: str, code: int, said: str) -> None:
    velod = f"{sys.executable} -P -m velod.cli config show {where}"
    done = subprocess.run(["sh", "-c", velod], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (code, said)


def test_what_a_terminal_cannot_show_is_a_question_mark(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (settings := tmp_path / "velod.toml").write_text('[rig]\ncalibration = "r\u00fcckw\u00e4rts.yaml"\n', "utf-8")
    shown = BytesIO()
    monkeypatch.setattr(sys, "stdout", TextIOWrapper(shown, "ascii", write_through=True))
    assert main(["config", "show", "-c", str(settings)]) == 0
    assert b'calibration = "r?ckw?rts.yaml"' in shown.getvalue()


# --- what comes out ---


def test_replay_writes_every_velocity_as_csv(
    capsys: pytest.CaptureFixture[str], recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.csv"
    assert main(["replay", str(recording), "--offline", "--csv", str(out)]) == 0
    text = out.read_text()
    assert text.splitlines()[0] == CSV_HEADER
    rows = list(csv.DictReader(text.splitlines()))
    valid = [row for row in rows if row["valid"] == "1"]
    assert len(rows) >= len(valid) > 20
    truth = open_recording(recording).truth
    assert truth is not None
    v = np.array([[float(row[c]) for c in ("vx", "vy", "vz")] for row in valid])
    t_ns = np.array([int(row["t_ns"]) for row in valid])
    inside = t_ns <= truth.t_ns[-1]
    assert np.abs(v[inside] - truth_at(truth, t_ns[inside])).mean() < 0.3
    assert {row["state"] for row in valid} <= {"tracking", "degraded"}
    assert all(0.0 <= float(row["age_ms"]) < 100.0 for row in valid)
    assert all(0.0 <= float(row["bridged_ms"]) < 100.0 for row in valid)
    up = np.array([[float(row[c] or "nan") for c in ("up_x", "up_y", "up_z")] for row in valid])
    assert np.allclose(np.linalg.norm(up[-10:], axis=1), 1.0) and {row["frame"] for row in valid} == {"imu"}
    assert all(float(row["cov_xx"]) > 0.0 for row in valid)
    shown = capsys.readouterr().out
    assert re.search(r"AVE +0\.\d{4} m/s", shown) and "75.00 Hz" in shown


def test_eval_writes_the_documented_keys_and_nulls_what_offline_cannot_know(
    capsys: pytest.CaptureFixture[str], recording: Path
) -> None:
    assert main(["eval", str(recording), "--offline", "--json", "-"]) == 0
    captured = capsys.readouterr()
    result = json.loads(captured.out)
    assert list(result) == EVAL_KEYS
    assert result["ave_mps"] < 0.5 and result["n"] > 20 and result["real_time_factor"] > 0.0
    assert result["latency_p50_ms"] is None and result["latency_p99_ms"] is None and result["ave_floor_mps"] is None
    assert "AVE" in captured.err


def test_eval_of_several_files_is_a_list_and_pictures_are_drawn(recording: Path, tmp_path: Path) -> None:
    out, pictures = tmp_path / "out.json", tmp_path / "pictures"
    argv = ["eval", str(recording), str(recording), "--offline", "--json", str(out), "--plot", str(pictures)]
    assert main(argv) == 0
    first, second = json.loads(out.read_text())
    assert {**first, "real_time_factor": 0} == {**second, "real_time_factor": 0}
    assert {p.name for p in pictures.iterdir()} == {"slanted_velocity.png", "slanted_error.png"}


def test_simulated_files_are_recordings(tmp_path: Path) -> None:
    path = tmp_path / "sim.h5"
    assert main(["sim", "boxes-4", "-o", str(path), "--seconds", "0.05", "--seed", "3"]) == 0
    assert open_recording(path).truth is not None


# --- settings ---


def test_a_simulation_that_is_told_to_end_leaves_no_file(tmp_path: Path) -> None:
    command = [sys.executable, "-P", "-m", "velod.cli", "sim", "corridor-1", "-o", str(tmp_path / "a.h5")]
    with subprocess.Popen([*command, "--seconds", "60"], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == "simulating 60 s of corridor-1\n"
        assert list(tmp_path.iterdir()), "it is at work"
        process.terminate()
        assert process.wait(30) == 130
    assert list(tmp_path.iterdir()) == []


def test_written_settings_are_the_defaults_and_are_not_overwritten(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "velod.toml"
    assert main(["config", "init", str(path)]) == 0
    assert main(["config", "check", str(path)]) == 0
    assert config.load(path) == Settings()
    capsys.readouterr()
    assert "exists already" in error_of(capsys, "config", "init", str(path))
    path.write_text("[flow]\nworkers = 2\n")
    assert main(["config", "init", "--force", str(path)]) == 0
    assert config.load(path) == Settings()


def test_the_settings_in_effect_are_shown(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "velod.toml"
    path.write_text("[flow]\nworkers = 2\n")
    assert main(["config", "show", "-c", str(path)]) == 0
    shown = tomllib.loads(capsys.readouterr().out)
    assert shown["flow"]["workers"] == 2 and shown["depth"]["workers"] == 1


def test_a_calibration_is_shown_as_velods_own(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path, shown = tmp_path / "rig.yaml", tmp_path / "shown.yaml"
    save_calibration(path, slanted_scene.RIG)
    assert main(["config", "calibration", str(path)]) == 0
    shown.write_text(capsys.readouterr().out)
    assert load_calibration(shown).left == slanted_scene.CAMERA
