"""Tables of a comparison: what stands in them, how it is rounded, and what is said about it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from velod.eval.compare import METHODS, Judged, Judgement, judge
from velod.eval.imu_alone import ImuAlone
from velod.eval.markdown import MarkdownError, put_into
from velod.eval.metrics import evaluate
from velod.eval.paper import PAPER, TABLE_IV_MS
from velod.eval.stage_errors import DepthErrors, FlowErrors, Group, StageErrors
from velod.eval.stage_tables import group_tables, overview_tables
from velod.eval.table import (
    Row,
    as_json,
    ave_table,
    detail_table,
    imu_table,
    notes,
    paper_table,
    quartile_table,
    rve_table,
    spread,
    text_table,
)
from velod.io.model import Imu, Truth
from velod.types import Velocity

T_NS = np.arange(0, 1_000_000_001, 10_000_000)
TRUTH = Truth(
    T_NS,
    np.tile([2.0, 0.0, 0.0], (len(T_NS), 1)),
    np.zeros((len(T_NS), 3)),
    np.tile([0.0, 0.0, 0.0, 1.0], (len(T_NS), 1)),
)
IMU = Imu(T_NS, np.tile([0.0, 0.0, 9.81], (len(T_NS), 1)), np.zeros((len(T_NS), 3)))


def off_by(error_mps: float, valid: bool = True) -> list[Velocity]:
    return [
        Velocity(k, int(t), np.array([2.0 + error_mps, 0.0, 0.0]), np.eye(3), valid, "tracking", "", k, int(t))
        for k, t in enumerate(T_NS)
    ]


def judged(error_mps: float, valid: bool = True) -> Judged:
    return judge(off_by(error_mps, valid), IMU, TRUTH, 0)


def row(name: str = "corridor-1", **errors: list[float]) -> Row:
    judgement: Judgement = {method: [judged(e) for e in values] for method, values in errors.items()}
    return Row(name, 10.0, judgement, ImuAlone((30.0, 90.0), np.array([[0.5, 2.0], [1.0, 4.0]])))


def cell(table: list[list[str]], column: str, line: int = 1) -> str:
    return table[line][table[0].index(column)]


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([0.0312, 0.0288], "0.030±0.002"),
        ([1.5], "1.50"),
        ([17.0, 19.0], "18.00±1.41"),
        ([682.7], "683"),
        ([math.nan], "-"),
        ([], "-"),
        ([math.inf, 2.0], "2.00"),
    ],
)
def test_a_mean_is_shown_with_its_spread_and_no_more_digits_than_it_has(values: list[float], text: str) -> None:
    assert spread(values).text() == text


def test_each_method_stands_in_its_column_beside_the_papers_numbers() -> None:
    table = ave_table([row(velod=[0.03, 0.05], linear=[0.2])])
    assert cell(table, "velod") == "0.040±0.014"
    assert cell(table, "linear") == "0.200"
    assert cell(table, "floor") == "-"
    assert cell(table, "IMU, s") == "90"
    assert cell(table, "IMU long") == "3.00±1.41"
    assert table[1][-4:] == ["0.09", "2.67", "10.78", "Table II"]


def test_relative_errors_stand_beside_the_papers_error_over_its_speed() -> None:
    table = rve_table([row(velod=[0.03])])
    assert cell(table, "velod") == "1.50"
    assert cell(table, "paper: AVE/speed") == "1.58"


def test_the_quartiles_of_the_relative_error_are_the_boxes_of_fig_7() -> None:
    table = quartile_table([row(velod=[0.03, 0.05])])
    assert cell(table, "velod") == "2 / 2 / 2"
    assert cell(table, "linear") == "-"


def test_the_imu_alone_is_shown_over_time_with_how_rare_the_papers_error_is() -> None:
    table = imu_table([row(velod=[0.03]), Row("mine", 1.0, {"velod": [judged(0.1)]})])
    assert table[0] == ["sequence", "noises", "30 s", "90 s", "paper: IMU", "noises below it at"]
    assert table[1:] == [["corridor-1", "2", "0.75 (0.53 - 0.97)", "3.00 (2.10 - 3.90)", "2.67", "90 s: 50 %"]]


def test_the_papers_own_tables_are_shown_with_what_failed() -> None:
    table = paper_table()
    assert len(table) == 9
    assert table[1] == ["Synthetic_1", "corridor-1", "2.67", "0.48", "1.31", "failed", "10.78", "0.09", "Table II"]


def test_a_recording_that_the_paper_does_not_have_stands_alone() -> None:
    table = ave_table([Row("mine", 1.0, {"velod": [judged(0.1)]})])
    assert table[1][-4:] == ["", "", "", ""]
    assert cell(table, "IMU long") == ""


def test_a_method_without_a_valid_velocity_is_judged_all_the_same_and_marked() -> None:
    rows = [Row("corridor-1", 1.0, {"velod": [judged(0.1)], "Benosman-NF": [judged(10.0, valid=False)]})]
    assert cell(ave_table(rows), "Benosman-NF") == "10.00*"
    assert cell(ave_table(rows), "velod") == "0.100"
    assert any(note.startswith("*") for note in notes(rows, [1]))
    assert not any(note.startswith("*") for note in notes([row(velod=[0.1])], [1]))


def test_simulated_spins_are_said_to_stand_beside_real_ones() -> None:
    rows = [row("spin-2", velod=[0.05])]
    assert ave_table(rows)[1][-1] == "Table III r"
    assert any(note.startswith("r ") for note in notes(rows, [1]))


def test_only_velocities_from_the_first_valid_one_on_are_judged() -> None:
    velocities = off_by(5.0, valid=False)[:50] + off_by(0.1)[50:]
    result = judge(velocities, IMU, TRUTH, 0)
    t_ns, error, relative = result.errors(TRUTH)
    assert t_ns[0] == T_NS[50] == result.metrics.first_valid_s * 1e9
    np.testing.assert_allclose(error, 0.1)
    np.testing.assert_allclose(relative, 5.0)
    assert error.mean() == pytest.approx(result.metrics.ave_mps)


def test_drift_is_that_of_dead_reckoning() -> None:
    assert float(cell(detail_table([row(velod=[0.1])]), "drift %: velod")) == pytest.approx(5.0)


def test_columns_are_aligned_and_numbers_stand_to_the_right() -> None:
    assert text_table([["name", "n"], ["a", "10"], ["longer", "7"]]) == "name     n\na       10\nlonger   7"


def test_what_is_not_known_is_null_in_the_json() -> None:
    tree = json.loads(json.dumps(as_json([Row("mine", 1.0, {"velod": [judged(0.1)]})], []), allow_nan=False))
    velod = tree["sequences"][0]["methods"]["velod"]
    assert velod["ave_mps"] == {"mean": pytest.approx(0.1), "spread": None, "values": [pytest.approx(0.1)]}
    assert velod["ever_valid"] is True
    assert tree["sequences"][0]["paper"] is None


def test_the_papers_tables_are_complete() -> None:
    assert len(PAPER) == 8
    # Ours wins every row of Tables II and III, as the paper says.
    assert all(p.ours_mps < min(p.imu_mps, p.benosman_mps) for p in PAPER.values())
    assert TABLE_IV_MS["overall"] == sum(TABLE_IV_MS[k] for k in ("preprocessing", "flow and depth", "back end"))


def test_every_method_has_a_column_and_an_explanation() -> None:
    assert set(METHODS) <= set(ave_table([])[0])
    assert all(any(note.startswith(m) for note in notes([], [1, 2])) for m in METHODS if m != "velod")


def test_judging_agrees_with_the_metrics_of_velod_eval() -> None:
    velocities = off_by(0.1)
    assert judge(velocities, IMU, TRUTH, 0).metrics == evaluate(velocities, TRUTH, 0)


def stages(**changes: object) -> StageErrors:
    flow = FlowErrors(1000, -0.002, 0.0004, 0.03, 0.001, 0.9, 1.1, 0.02, 0.0011, 0.0001)
    depth = DepthErrors(800, 0.0031, 0.001, 0.04, 0.02, -0.001, 0.012, math.nan, 0.95, 0.005)
    groups = {"polarity": [Group("ON", flow, depth), Group("OFF", replace(flow, n=0, bias=math.nan), depth)]}
    known = StageErrors("casting", 2000, 0.9, 0.1, 0.99, 0.8, 0.88, 0.75, flow, depth, depth, depth, groups)
    return replace(known, **changes)  # type: ignore[arg-type]


def test_stage_errors_are_shown_in_percent_and_pixels_and_a_dash_where_there_is_no_truth() -> None:
    shares, flow, depth = overview_tables({"a": stages(), "b": None}).values()
    assert shares[1] == ["a", "2000", "90.0", "10.0", "99.0", "80.0", "88.0", "75.0"]
    assert flow[1] == ["a", "1000", "-0.20", "0.04", "3.00", "0.10", "0.90", "1.10", "2.00", "1.10", "0.10"]
    assert [line[1] for line in depth[1:4]] == ["all", "refined", "block"]
    assert depth[1][2:] == ["800", "0.003", "0.001", "0.040", "2.00", "-0.10", "1.20", "-", "0.95", "0.50"]
    assert all(set(table[-1][1:]) == {"-"} for table in (shares, flow, depth))


def test_groups_of_events_have_a_line_each() -> None:
    flow, depth = group_tables({"a": stages(), "b": None}).values()
    assert [line[:3] for line in flow[1:]] == [["a", "ON", "1000"], ["a", "OFF", "0"]]
    assert flow[2][3] == "-"
    assert len(depth) == 3


def test_stage_errors_of_the_json_have_the_names_of_the_fields_and_null_for_the_unknown() -> None:
    one = {"velod": [judged(0.1)]}
    first, second = as_json([Row("a", 1.0, one, stages=stages()), Row("b", 1.0, one)], [])["sequences"]
    assert first["stages"]["flow"]["bias"] == -0.002
    assert first["stages"]["depth"]["sigmas"] is None
    assert first["stages"]["groups"]["polarity"][1]["label"] == "OFF"
    assert second["stages"] is None


def test_tables_take_the_place_of_those_of_an_earlier_run(tmp_path: Path) -> None:
    page = tmp_path / "results.md"
    page.write_text("# A\n<!-- velod eval x -->\nold\n<!-- end -->\n\n<!-- velod eval y -->\n<!-- end -->\nlast\n")
    for value in ("1", "2"):
        put_into(page, "velod eval x", "abc123", {"T": [["name", "n"], ["a", value]]}, ["A note."])
    assert page.read_text() == (
        "# A\n<!-- velod eval x -->\n"
        "`velod eval x` at `abc123`:\n\n```\nT\nname  n\na     2\n\nA note.\n```\n<!-- end -->\n\n"
        "<!-- velod eval y -->\n<!-- end -->\nlast\n"
    )
    with pytest.raises(MarkdownError, match="no place"):
        put_into(page, "velod eval z", "abc123", {}, [])
