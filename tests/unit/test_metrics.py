"""AVE, RVE and NEES on cases whose answers are known."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from velod.eval.metrics import angle_deg, evaluate, median_direction, median_speed_mps, nees, truth_at
from velod.eval.plots import PlotError, plot_run
from velod.io import Truth
from velod.types import Velocity


def truth() -> Truth:
    """v = (t, 0, 2) over 0..10 s."""
    t_ns = np.arange(0, 10_000_000_001, 1_000_000_000, dtype=np.int64)
    v_B = np.stack([t_ns / 1e9, np.zeros(11), np.full(11, 2.0)], axis=1)
    return Truth(t_ns, v_B, np.zeros((11, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (11, 1)))


def velocity(t_s: float, v: tuple[float, float, float], valid: bool = True, sigma: float = 0.1) -> Velocity:
    return Velocity(0, round(t_s * 1e9), np.array(v), np.eye(3) * sigma**2, valid, "tracking", "", 0, 0)


def test_the_truth_is_interpolated_at_the_estimates_time() -> None:
    assert truth_at(truth(), np.array([2_500_000_000]))[0].tolist() == [2.5, 0.0, 2.0]


def test_ave_and_rve_are_means_over_what_was_published() -> None:
    got = evaluate([velocity(1.5, (1.5, 0.28, 2.0)), velocity(2.5, (2.5, 0.0, 2.08))], truth())
    assert got.n == 2
    assert got.ave_mps == pytest.approx(0.18)
    assert got.rve_percent == pytest.approx(50 * (0.28 / math.hypot(1.5, 2) + 0.08 / math.hypot(2.5, 2)))
    assert got.rve_quartiles_percent[1] == pytest.approx(got.rve_percent)  # of two, the median is the mean
    assert got.rve_quartiles_percent[0] < got.rve_quartiles_percent[1] < got.rve_quartiles_percent[2]
    assert got.rve_quartiles_percent[2] < got.rve_p95_percent < 11.2
    assert got.nees_mean == pytest.approx((7.84 + 0.64) / 2)
    assert (got.within_1_sigma, got.within_2_sigma, got.within_3_sigma) == pytest.approx((0.5, 0.5, 1.0))


def test_start_up_is_not_judged_and_a_later_invalid_velocity_is() -> None:
    stream = [
        velocity(1.0, (9.0, 9.0, 9.0), valid=False),
        velocity(2.0, (2.0, 0.0, 2.0)),
        velocity(3.0, (3.0, 0.4, 2.0), valid=False),
        velocity(4.0, (math.nan, 0.0, 2.0), valid=False),
    ]
    got = evaluate(stream, truth(), t_start_ns=500_000_000)
    assert got.n == 2
    assert got.ave_mps == pytest.approx(0.2)
    assert got.first_valid_s == pytest.approx(1.5)
    assert got.valid_fraction == pytest.approx(1 / 3)
    assert got.nees_mean == pytest.approx(0.0)


def test_a_valid_velocity_of_nan_spoils_the_mean_and_is_not_hidden() -> None:
    got = evaluate([velocity(1.0, (1.0, 0.0, 2.0)), velocity(2.0, (math.nan, 0.0, 2.0))], truth())
    assert math.isnan(got.ave_mps)


def test_estimates_beyond_the_truth_are_not_extrapolated() -> None:
    assert evaluate([velocity(9.0, (9.0, 0.0, 2.0)), velocity(11.0, (0.0, 0.0, 0.0))], truth()).n == 1


@pytest.mark.parametrize(
    "stream", [[], [velocity(1.0, (1.0, 0.0, 2.0), valid=False)], [velocity(11.0, (0.0, 0.0, 0.0))]]
)
def test_nothing_to_judge_gives_n_0_and_nulls(stream: list[Velocity]) -> None:
    got = evaluate(stream, truth())
    assert got.n == 0
    assert got.row()["ave_mps"] is None
    assert "no valid velocity" in got.summary()
    json.dumps(got.row(), allow_nan=False)


def test_an_honest_covariance_has_nees_3() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3))
    error = rng.normal(size=(20_000, 3)) @ root.T
    squared = nees(error, np.tile(root @ root.T, (20_000, 1, 1)))
    assert squared.mean() == pytest.approx(3.0, abs=0.06)
    assert [np.mean(squared <= k * k) for k in (1, 2, 3)] == pytest.approx([0.199, 0.739, 0.971], abs=0.01)


def test_a_covariance_that_is_none_has_infinite_nees() -> None:
    assert nees(np.ones((2, 3)), np.array([np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan)])).tolist() == [
        math.inf,
        math.inf,
    ]


def test_median_speed_and_direction_ignore_invalid_velocities() -> None:
    stream = [velocity(i, (0.3, 0.0, 0.0)) for i in range(5)] + [velocity(6, (9.0, 9.0, 9.0), valid=False)]
    assert median_speed_mps(stream) == pytest.approx(0.3)
    assert angle_deg(median_direction(stream), np.array([1.0, 0.0, 0.0])) == pytest.approx(0.0)
    assert angle_deg(median_direction(stream), np.array([0.0, 0.0, 2.0])) == pytest.approx(90.0)


def test_plots_are_written(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    stream = [velocity(i / 10, (i / 10, 0.0, 2.0)) for i in range(50)]
    written = plot_run(stream, truth(), tmp_path, "run")
    assert [p.name for p in written] == ["run_velocity.png", "run_error.png"]
    assert all(p.stat().st_size > 5000 for p in written)


def test_a_run_without_a_valid_velocity_cannot_be_plotted(tmp_path: Path) -> None:
    with pytest.raises(PlotError, match="no valid velocity"):
        plot_run([velocity(1, (0.0, 0.0, 0.0), valid=False)], truth(), tmp_path, "run")
