"""The depth stage on edges whose disparity is known exactly."""

from dataclasses import replace

import numpy as np
import pytest

from tests.moving_edge import PLAIN, PLAIN_RIG, Edge, batch, without_right
from velod.config import DepthSettings, Settings
from velod.depth.refine import INFLATION
from velod.depth.stage import DepthStage
from velod.events.plane_fit import USUAL_RMS_PX, USUAL_WEIGHT
from velod.geometry import so3
from velod.geometry.calibration import Calibration, Camera
from velod.types import DepthBatch, StereoBatch

RADTAN = Camera(240, 180, 201.0, 200.0, 118.0, 91.0, "radtan", (-0.3, 0.1, 0.001, -0.001))
EQUI = Camera(240, 180, 199.0, 198.5, 121.0, 88.0, "equi", (-0.05, 0.01, -0.05, 0.02))
RIGS = {
    "rectified": PLAIN_RIG,
    "distorted and tilted": Calibration(RADTAN, EQUI, so3.exp([0.01, -0.02, 0.015]), np.array([-0.1, 0.002, -0.001])),
}


def run(
    message: StereoBatch, calibration: Calibration = PLAIN_RIG, **depth: object
) -> tuple[DepthBatch, dict[str, int]]:
    stage = DepthStage(Settings(depth=DepthSettings(**depth)), calibration)  # type: ignore[arg-type]
    (out,) = stage.handle(message)
    return out, stage.counters


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("angle", [0.0, 0.6, -1.0])
@pytest.mark.parametrize("disparity_px", [3.0, 7.37, 21.5])
def test_a_moving_edge_gives_its_exact_disparity(rig: str, angle: float, disparity_px: float) -> None:
    message = batch(Edge(angle=angle, disparity_px=disparity_px), calibration=RIGS[rig])
    out, _ = run(message, RIGS[rig])
    refined = out.refined == 1
    assert refined.sum() > 0.8 * len(message.x)
    # On the distorted grid the plane is bent by the lens within the 5 x 5 pixels.
    np.testing.assert_allclose(out.disparity[refined], disparity_px, atol=0.005 if rig == "rectified" else 0.05)


def test_inverse_depth_and_its_sigma_are_disparities_over_f_b() -> None:
    out, _ = run(batch(Edge()))
    f_b = 200.0 * 0.1
    np.testing.assert_allclose(out.inv_depth, out.disparity / f_b, rtol=1e-6)
    # An edge without jitter on two planes of 49 neighbours: what is usual of their residuals, at the angle's cosine.
    of_neighbour_px = INFLATION * USUAL_RMS_PX * np.sqrt(USUAL_WEIGHT / (46 + USUAL_WEIGHT))
    of_planes_px = np.sqrt(2 / 49) * of_neighbour_px / np.cos(0.2)
    refined = out.refined == 1
    np.testing.assert_allclose(np.median(out.sigma[refined]) * f_b, np.hypot(of_planes_px, 0.01), rtol=0.02)


def test_the_sigma_of_refined_matches_is_honest_under_jitter() -> None:
    residuals = []
    for seed in range(5):
        out, _ = run(batch(Edge(angle=0.4), jitter_s=0.2 / 300.0, seed=seed))
        refined = out.refined == 1
        residuals.append((out.disparity[refined] - 7.37) / (20.0 * out.sigma[refined]))
    z = np.concatenate(residuals)
    assert len(z) > 300
    assert 0.6 < z.std() < 1.4
    assert abs(np.median(z)) < 0.2


def test_block_matching_alone_says_so_and_has_the_larger_sigma() -> None:
    out, counters = run(batch(Edge()), refine=False)
    assert (out.refined == 0).all()
    assert counters["points.block"] == len(out.index) > 100
    np.testing.assert_allclose(out.sigma * 20.0, 0.35, rtol=1e-5)
    np.testing.assert_allclose(out.disparity, 7.37, atol=0.5)


def test_an_edge_that_lies_in_the_row_is_not_refined_and_has_a_larger_sigma_still() -> None:
    # Beside the flat edge a vertical one gives block matching something to hold.
    message = batch(Edge(angle=1.5, x_px=400.0), Edge(angle=0.0, x_px=150.0))
    out, counters = run(message, min_zncc=-1.0)
    flat = out.refined == 0
    assert counters["unrefined.flat_edge"] > 20
    assert flat.sum() > 0
    assert (out.sigma[flat] * 20.0 >= 0.35).all()
    assert np.max(out.sigma[flat]) * 20.0 == pytest.approx(3.5, rel=1e-5)


def test_points_come_in_the_order_of_the_batch_and_carry_their_index() -> None:
    message = batch(Edge())
    some = np.arange(0, len(message.x), 3)
    part = replace(message, x=message.x[some], y=message.y[some], age=message.age[some], p=message.p[some])
    whole, third = run(message)[0], run(part)[0]
    assert (np.diff(whole.index.astype(int)) > 0).all()
    kept = np.isin(whole.index, some)
    np.testing.assert_array_equal(some[third.index], whole.index[kept])
    np.testing.assert_array_equal(third.disparity, whole.disparity[kept])
    assert (whole.seq, whole.t_ns, whole.n_selected) == (message.seq, message.t_ns, len(message.x))


def test_a_batch_gives_the_same_bits_whatever_came_before() -> None:
    first, second = batch(Edge()), batch(Edge(disparity_px=12.2, angle=-0.5), jitter_s=1e-4)
    stage = DepthStage(Settings(), PLAIN_RIG)
    stage.handle(first)
    (after,), (alone, _) = stage.handle(second), run(second)
    for column in ("index", "disparity", "inv_depth", "sigma", "refined"):
        assert getattr(after, column).tobytes() == getattr(alone, column).tobytes()


def test_points_farther_than_the_least_disparity_are_dropped_and_counted() -> None:
    out, counters = run(batch(Edge(disparity_px=3.0)), min_disparity_px=5.0)
    assert len(out.index) == 0
    assert counters["points.too_far"] > 100


def test_without_the_right_camera_nothing_is_published_and_everything_is_counted() -> None:
    message = without_right(batch(Edge()))
    out, counters = run(message)
    assert len(out.index) == 0
    assert counters["points"] == len(message.x)
    assert counters["points.no_match"] + counters["points.unconfirmed"] == len(message.x)


def test_every_point_is_counted_once() -> None:
    message = batch(Edge(), jitter_s=5e-4)
    out, counters = run(message)
    fates = ("refined", "block", "no_match", "low_zncc", "ambiguous", "too_far")
    assert sum(counters[f"points.{fate}"] for fate in fates) == counters["points"] == len(message.x)
    assert counters["points.refined"] + counters["points.block"] == len(out.index)


def test_an_empty_batch_gives_an_empty_one() -> None:
    message = batch(Edge(), points=0)
    out, _ = run(message)
    assert (out.n_selected, len(out.index)) == (0, 0)


def test_an_edge_that_is_missing_on_the_right_is_ambiguous_unless_the_check_is_off() -> None:
    """Two edges in the left image, one in the right: the second's only candidate belongs to the first."""
    first = Edge(x_px=110.0, angle=0.0, disparity_px=5.0)
    both, one = batch(first, replace(first, x_px=135.0, speed_px_s=150.0)), batch(first)
    message = replace(both, right=one.right, right_last=one.right_last)
    stray = message.x > 115
    assert stray.sum() > 30
    checked, counters = run(message, block_only="all")
    unchecked, _ = run(message, check="none", block_only="all")
    assert np.isin(unchecked.index, np.flatnonzero(stray)).sum() > 20
    assert np.isin(checked.index, np.flatnonzero(stray)).sum() == 0
    assert counters["points.ambiguous"] > 20


@pytest.mark.parametrize("check", ["left-right", "uniqueness", "none"])
def test_every_check_keeps_an_unambiguous_edge(check: str) -> None:
    message = batch(Edge())
    out, _ = run(message, check=check)
    assert len(out.index) > 0.9 * len(message.x)


def _wrong_sizes() -> dict[str, StereoBatch]:
    good = batch(Edge())
    outside = good.x.copy()
    outside[0] = PLAIN.width
    polarity = good.p.copy()
    polarity[0] = 2
    return {
        "left surface": replace(good, left=good.left[:, :-1]),
        "right surface": replace(good, right_last=good.right_last[:, :-1]),
        "event outside": replace(good, x=outside),
        "polarity": replace(good, p=polarity),
        "unit": replace(good, unit_ns=0),
    }


@pytest.mark.parametrize("wrong", ["left surface", "right surface", "event outside", "polarity", "unit"])
def test_a_batch_that_does_not_fit_the_calibration_is_dropped_and_counted(wrong: str) -> None:
    stage = DepthStage(Settings(), PLAIN_RIG)
    assert stage.handle(_wrong_sizes()[wrong]) == []
    assert stage.counters == {"batches.size": 1}


def test_a_match_that_refinement_could_have_confirmed_and_did_not_is_dropped() -> None:
    """The right camera has the edge in the other polarity: block matching, which sees no polarity, matches."""
    message = batch(Edge())
    message = replace(message, right=message.right[::-1].copy())
    strict, counters = run(message)
    lenient, _ = run(message, block_only="all")
    assert len(lenient.index) > 20
    assert len(strict.index) == 0
    assert counters["points.unconfirmed"] >= len(lenient.index)
