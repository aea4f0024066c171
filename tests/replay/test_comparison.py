"""velod and its baselines over one short simulated recording: the table, the floor and the report."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from velod.cli import main
from velod.cli.compare import floor_mps
from velod.config import Settings
from velod.eval.compare import METHODS
from velod.io import open_recording


@pytest.fixture(scope="module")
def compared(simulated: Callable[[str, float], Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a report, with the JSON beside the page."""
    directory = tmp_path_factory.mktemp("report")
    recording = simulated("boxes-4", 0.6)
    assert main(["eval", str(recording), "--report", str(directory), "--json", str(directory / "out.json")]) == 0
    return directory


def ave(compared: Path, method: str) -> float:
    sequences = json.loads((compared / "out.json").read_text())["sequences"]
    return float(sequences[0]["methods"][method]["ave_mps"]["mean"])


def test_the_methods_come_out_in_the_order_that_theory_demands(compared: Path) -> None:
    assert ave(compared, "floor") < ave(compared, "velod") < ave(compared, "linear")
    assert ave(compared, "velod") < 0.1
    assert ave(compared, "Benosman-NF") > 1.0


def test_the_floor_is_what_its_covariance_says_of_the_imus_noise_alone(compared: Path) -> None:
    """With perfect flow and depth the stated covariance is that of noise alone; at most 1.2 times what it expects."""
    runs = json.loads((compared / "out.json").read_text())["sequences"][0]["methods"]["floor"]["runs"]
    # The mean of e^T cov^-1 e is 3 sigma^2-units for three components.
    assert np.sqrt(runs[0]["nees_mean"] / 3.0) < 1.2


def test_the_floor_of_eval_is_the_one_of_the_table(simulated: Callable[[str, float], Path], compared: Path) -> None:
    recording = open_recording(simulated("boxes-4", 0.6))
    assert floor_mps(Settings(), recording) == pytest.approx(ave(compared, "floor"), abs=1e-12)


def test_a_rig_that_the_floor_cannot_be_had_for_has_none(simulated: Callable[[str, float], Path]) -> None:
    recording = open_recording(simulated("boxes-4", 0.6))
    lens = replace(recording.calibration.left, model="equi", dist=(0.1, 0.0, 0.0, 0.0))
    distorted = replace(recording, calibration=replace(recording.calibration, left=lens, right=lens))
    assert floor_mps(Settings(), distorted) is None


def test_the_page_holds_everything_and_asks_for_nothing_else(compared: Path) -> None:
    page = (compared / "report.html").read_text()
    sources = re.findall(r'src="([^"]{0,30})', page)
    assert len(sources) == 5
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert not re.search(r"https?://", page)
    assert all(f"<th>{method}</th>" in page for method in METHODS)
    for picture in ("methods", "velocity", "track", "events"):
        assert any(p.stem.endswith(picture) for p in compared.glob("*.png"))


def test_the_page_says_where_the_time_goes(compared: Path) -> None:
    page = (compared / "report.html").read_text()
    rows = re.findall(r"<tr><td>boxes-4[^<]*</td>((?:<td>-?[0-9.]+</td>){6})</tr>", page)
    milliseconds = [float(t) for t in re.findall(r">(-?[0-9.]+)<", rows[-1])]
    preprocessing, flow, depth, both, back_end, overall = milliseconds
    assert min(preprocessing, flow, depth, back_end) > 0.0
    assert both == pytest.approx(flow + depth, abs=0.11)
    assert overall == pytest.approx(preprocessing + both + back_end, abs=0.21)


def test_a_recording_without_truth_cannot_be_compared(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["eval", str(tmp_path / "missing.h5"), "--report", str(tmp_path)]) == 2
    assert "no such file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "Give recordings, or --table synthetic"),
        (["--quick"], "--quick goes with --table"),
        (["a.h5", "--table", "synthetic"], "not both"),
        (["--stages", "--table", "synthetic"], "--stages goes with recordings"),
        (["a.h5", "--stages", "--report", "page"], "--stages goes with recordings"),
        (["a.h5", "--stages", "--floor"], "--stages judges flow and depth alone"),
        (["a.h5", "--jobs", "2"], "--jobs goes with --table"),
        (["--table", "held-out", "--plot", "page"], "--plot goes with recordings"),
    ],
)
def test_what_cannot_be_meant_is_refused(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", *arguments]) == 2
    assert complaint in capsys.readouterr().err


def test_the_table_simulates_its_sequences_and_draws_the_imus_noise_anew_for_each_seed(
    simulated: Callable[[str, float], Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cache = simulated("boxes-4", 0.6).parent.parent
    monkeypatch.setenv("VELOD_CACHE_DIR", str(cache))
    monkeypatch.setattr("velod.sim.TABLE_I", {"boxes-4": (2.77, 2.05)})
    monkeypatch.setattr("velod.cli.compare._SECONDS", {"boxes": 0.6})
    monkeypatch.setattr("velod.cli.compare._IMU_SECONDS", {"boxes": 2.0})
    monkeypatch.setattr("velod.cli.compare._IMU_NOISES", 3)
    monkeypatch.setattr("velod.cli.compare._SEEDS", (1, 2))
    assert main(["eval", "--table", "synthetic", "--json", "-"]) == 0
    out, err = capsys.readouterr()
    tree = json.loads(out)
    found = tree["sequences"][0]["methods"]["velod"]["ave_mps"]
    assert tree["imu_seeds"] == [1, 2]
    assert len(set(found["values"])) == 2
    assert found["mean"] == pytest.approx(np.mean(found["values"]))
    assert tree["sequences"][0]["imu_alone"]["seconds"] == [2.0]
    assert len(tree["sequences"][0]["imu_alone"]["ave_mps"]) == 3
    assert tree["sequences"][0]["paper"]["ave_mps"]["ours"] == 0.06
    assert "Table II" in err
    assert "boxes-4: done" in err
    # What is done is kept: the second run takes it, and says the same.
    kept = {path: path.stat().st_mtime_ns for path in (cache / "eval").iterdir()}
    assert kept
    assert main(["eval", "--table", "synthetic", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out) == tree
    assert {path: path.stat().st_mtime_ns for path in (cache / "eval").iterdir()} == kept
