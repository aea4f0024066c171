"""`velod bench` at a tiny size: what it writes, and that what it compares computes the same. No times are judged."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from velod.cli.bench import bench
from velod.eval import bench_input
from velod.eval.bench import Case, Result, Size, measure
from velod.eval.bench_cases import GROUPS, cases
from velod.eval.latency import LEGS
from velod.types import Velocity

TINY = Size(repeats=2, peer_repeats=1, seconds=0.12, dataflow_seconds=0.5, events=20_000, flows=60, window=20)

NAMES = {
    "flow": ["events.sae", "flow.plane_fit", "flow.event_by_event", "flow.worker"],
    "depth": ["depth.sparse_500", "depth.worker"],
    "solve": ["solve.window", "output.imu_rate"],
    "codec": ["codec.batch"],
    "pipeline": ["ingest.batch", "ingest.hd", "pipeline.one_process", "pipeline.sustained", "pipeline.event_to_flow"],
    "hop": ["hop.velod", "hop.zenoh"],
    "latency": [f"latency.{leg}" for leg in LEGS],
    "rate": ["rate.346x260", "rate.640x480", "rate.1280x720"],
}
PEERS = {"flow.plane_fit": 1e-3, "depth.sparse_500": 0.5, "solve.window": 1e-3, "codec.batch": 0.0}
"""How far a case may be from its peer: relative speed, px, relative information, differing fields."""


def no_pipeline(packets: object) -> list[Velocity]:
    raise AssertionError("only the group 'pipeline' runs the pipeline")


def test_all_writes_every_name_with_times_and_ratios(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "bench.json"
    assert bench("all", str(out), TINY) == 0
    rows = json.loads(out.read_text())
    assert [r["name"] for r in rows] == [
        name for group in (*GROUPS, "hop", "latency", "rate") for name in NAMES[group]
    ]
    table = capsys.readouterr().out
    for r in rows:
        assert r["name"] in table
        assert r["median_us"] > 0.0 and r["n"] >= 1
        if r["name"] in (*PEERS, *NAMES["hop"]):
            assert r["peer"] and r["ratio"] == pytest.approx(r["peer_median_us"] / r["median_us"])
        else:
            assert (r["peer"], r["peer_median_us"], r["ratio"]) == (None, None, None)
    assert all(r["p99_us"] >= r["median_us"] for r in rows if r["name"] in (*NAMES["latency"], *NAMES["rate"]))
    for r in rows:
        if r["name"] in NAMES["rate"]:
            assert 0.0 < r["mev_s"] <= r["offered_mev_s"] and 0.0 < r["batches_percent"] <= 100.0
    assert all(r["mev_s"] > 0.0 for r in rows if r["name"] in ("pipeline.one_process", "pipeline.sustained"))


@pytest.mark.parametrize("group", ["flow", "depth", "solve", "codec"])
def test_what_is_compared_computes_the_same(group: str) -> None:
    for case in cases(group, TINY, no_pipeline):
        assert (case.disagreement is not None) == (case.name in PEERS)
        if case.disagreement is not None:
            assert case.disagreement() <= PEERS[case.name], case.name


def test_an_unknown_group_is_refused() -> None:
    with pytest.raises(ValueError, match="no group 'walk'"):
        next(cases("walk", TINY, no_pipeline))


def test_times_are_per_unit_and_the_ratio_is_the_peers_over_ours() -> None:
    result = measure(Case("x", lambda: 8_000, per=4, clocked=True, events=16), TINY)
    assert (result.median_us, result.mev_s) == (2.0, 2.0)
    assert Result("x", 2.0, 1, peer="y", peer_median_us=6.0).row()["ratio"] == 3.0


def test_edges_are_as_fast_as_a_rate_wants_them() -> None:
    camera = bench_input.RIG.left
    made = bench_input.events(0.2, 0.0, seed=1, speed_px_s=bench_input.speed_for(6e6, camera))
    assert len(made.t_ns) == pytest.approx(0.2 * 6e6, rel=0.05)


def test_the_stream_is_the_seeds_and_both_cameras_see_the_same_edges() -> None:
    left, again, right = (bench_input.events(0.1, shift, seed=4) for shift in (0.0, 0.0, bench_input.DISPARITY_PX))
    assert np.array_equal(left.t_ns, again.t_ns) and np.array_equal(left.x, again.x)
    assert math.isclose(len(left.t_ns), len(right.t_ns), rel_tol=0.02)
    assert (np.diff(left.t_ns) >= 0).all()
    # a window in the middle, shifted by the disparity, is passed by the same number of edges
    there = (left.x >= 150) & (left.x < 200)
    same = (right.x >= 150 - bench_input.DISPARITY_PX) & (right.x < 200 - bench_input.DISPARITY_PX)
    assert abs(int(there.sum()) - int(same.sum())) < 200
