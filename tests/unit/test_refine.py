"""Plane coincidence against its numpy twin, and each way in which it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from tests.moving_edge import PLAIN_RIG, Edge, batch, without_right
from velod.depth import refine as module
from velod.depth.refine import OUTCOMES, Edges, Refined, left_edges, refine
from velod.events.plane_fit import fit_plane, widen_plane
from velod.geometry import so3
from velod.geometry.calibration import Calibration, Camera
from velod.geometry.rectify import Rectification, rectify
from velod.types import StereoBatch

RADTAN = Camera(240, 180, 201.0, 200.0, 118.0, 91.0, "radtan", (-0.3, 0.1, 0.001, -0.001))
TILTED_RIG = Calibration(RADTAN, RADTAN, so3.exp([0.01, -0.02, 0.015]), np.array([-0.1, 0.002, -0.001]))


def edges_of(message: StereoBatch, rect: Rectification) -> Edges:
    return left_edges(message.left, message.unit_ns, message.x, message.y, message.p, rect)


def refine_batch(message: StereoBatch, rect: Rectification, seed_px: float | np.ndarray) -> Refined:
    """One seed for each point."""
    seeds = np.broadcast_to(np.float64(seed_px), message.x.shape)
    of = np.arange(len(message.x))
    return refine(edges_of(message, rect), message.right, message.unit_ns, message.p, of, seeds, rect)


def outcomes(result: Refined) -> set[str]:
    return {OUTCOMES[k] for k in np.unique(result.outcome)}


def plane(
    surface: np.ndarray, p: int, x: int, y: int, unit_ns: int, least: int
) -> tuple[int, np.ndarray, float, float]:
    """(n, slope, time at the centre, rms) of the patch about (x, y)."""
    patch = surface[p, y - 3 : y + 4, x - 3 : x + 4] * (unit_ns / 1e9)
    fit = fit_plane(patch[1:6, 1:6].ravel(), 1.0, 2, least)
    n, gx, gy, t0, rms, *_ = widen_plane(fit, patch.ravel(), 1.0, 0.35)[0] if fit[0] else fit
    return n, np.array([gx, gy]), t0, rms


def twin(message: StereoBatch, rect: Rectification, k: int, seed: float) -> tuple[str, float]:
    """(outcome, disparity) of point k, step by step."""
    x, y, p, unit = int(message.x[k]), int(message.y[k]), int(message.p[k]), message.unit_ns
    n, g, t_left, _ = plane(message.left, p, x, y, unit, 20)
    if n == 0:
        return "no_left_plane", np.nan
    g_left = rect.left_covector[y, x].astype(np.float64) @ g
    if abs(g_left[0]) < module.MIN_NORMAL_X * np.linalg.norm(g_left):
        return "flat_edge", np.nan
    x_left, y_left = rect.left_xy[y, x].astype(np.float64)
    x_right = x_left - seed
    for _ in range(2):
        at = np.array(
            [map_coordinates(m.astype(np.float64), [[y_left], [x_right]], order=1)[0] for m in rect.remap_right]
        )
        px, py = np.rint(at).astype(int)
        n, g, t0, rms = plane(message.right, p, px, py, unit, 15)
        if n == 0:
            return "no_right_plane", np.nan
        g_right = rect.right_covector[py, px].astype(np.float64) @ g
        step = (t_left - t0 - g @ (at - [px, py])) / g_right[0]
        x_right += step
        if abs(x_left - x_right - seed) >= 1.5:
            return "too_far", np.nan
        if abs(step) < 0.75:
            if np.linalg.norm(g_right - g_left) > 0.3 * np.linalg.norm(g_left):
                return "slopes_differ", np.nan
            return ("residual", np.nan) if rms > 0.35 * np.linalg.norm(g) else ("refined", x_left - x_right)
    return "too_far", np.nan


@pytest.mark.parametrize("rig", [PLAIN_RIG, TILTED_RIG], ids=["rectified", "tilted"])
def test_every_outcome_and_disparity_equals_the_numpy_twins(rig: Calibration) -> None:
    rect = rectify(rig)
    seen: set[str] = set()
    for jitter_px in (0.0, 0.3, 0.8):
        message = batch(Edge(), Edge(angle=1.5, x_px=700.0), calibration=rig, points=60, jitter_s=jitter_px / 300.0)
        seeds = np.random.default_rng(5).uniform(5.5, 9.5, len(message.x)).astype(np.float32)
        result = refine_batch(message, rect, seeds)
        for k in range(len(message.x)):
            outcome, disparity = twin(message, rect, k, float(seeds[k]))
            assert OUTCOMES[result.outcome[k]] == outcome
            np.testing.assert_allclose(result.disparity[k], disparity, atol=1e-6)
            seen.add(outcome)
    assert {"refined", "no_left_plane", "too_far", "slopes_differ"} <= seen


@pytest.mark.parametrize("error_px", [-1.2, -0.5, 0.0, 0.6, 1.2])
def test_a_coarse_match_a_pixel_off_ends_at_the_same_place(error_px: float) -> None:
    message = batch(Edge(angle=0.3))
    result = refine_batch(message, rectify(PLAIN_RIG), 7.37 + error_px)
    assert outcomes(result) == {"refined"}
    np.testing.assert_allclose(result.disparity, 7.37, atol=0.005)


@pytest.mark.parametrize("error_px", [-4.0, -2.0, 2.0])
def test_a_coarse_match_farther_off_is_refused(error_px: float) -> None:
    result = refine_batch(batch(Edge()), rectify(PLAIN_RIG), 7.37 + error_px)
    assert (result.outcome != module.REFINED).all()


def test_the_normal_and_the_sigma_are_those_of_the_edge() -> None:
    rect, message = rectify(PLAIN_RIG), batch(Edge(angle=0.6), jitter_s=0.15 / 300.0)
    edges, result = edges_of(message, rect), refine_batch(message, rect, 7.37)
    good = result.outcome == module.REFINED
    assert good.sum() > 100
    # The edge moves to larger x, so the time of passage grows that way.
    normal_x = edges.slope_x / np.hypot(edges.slope_x, edges.slope_y)
    assert np.median(normal_x[good]) == pytest.approx(np.cos(0.6), abs=0.02)
    # Two planes of 49 neighbours with what is usual of their residuals, inflated; the scatter is that of white ones.
    assert np.median(result.sigma_px[good]) == pytest.approx(1.1 * 0.15 * np.sqrt(2 / 49) / np.cos(0.6), rel=0.1)
    assert np.std(result.disparity[good]) == pytest.approx(np.median(result.sigma_px[good]) / 1.1, rel=0.25)


def test_an_edge_in_the_row_an_absent_one_and_a_missing_seed_are_told_apart() -> None:
    rect = rectify(PLAIN_RIG)
    assert outcomes(refine_batch(batch(Edge(angle=1.5, x_px=400.0)), rect, 7.37)) == {"flat_edge"}
    assert outcomes(refine_batch(without_right(batch(Edge())), rect, 7.37)) == {"no_right_plane"}
    assert outcomes(refine_batch(batch(Edge()), rect, np.nan)) == {"no_seed"}


def test_seeds_of_one_edge_are_refined_each_by_itself() -> None:
    rect, message = rectify(PLAIN_RIG), batch(Edge(), points=20)
    of = np.repeat(np.arange(20), 3)
    seeds = np.tile([np.nan, 7.0, 12.0], 20)
    result = refine(edges_of(message, rect), message.right, message.unit_ns, message.p, of, seeds, rect)
    one = refine_batch(message, rect, 7.0)
    np.testing.assert_array_equal(result.disparity[1::3], one.disparity)
    assert (result.outcome[0::3] == module.NO_SEED).all()
    assert (result.outcome[2::3] != module.REFINED).all()


def test_an_edge_of_another_speed_is_refused() -> None:
    left, right = batch(Edge(angle=0.0)), batch(Edge(angle=0.0, speed_px_s=190.0))
    result = refine_batch(replace(left, right=right.right), rectify(PLAIN_RIG), 7.37)
    assert (result.outcome != module.REFINED).all()
    assert "slopes_differ" in outcomes(result)


def test_the_other_polarity_is_not_looked_at() -> None:
    message = batch(Edge())
    result = refine_batch(replace(message, right=message.right[::-1].copy()), rectify(PLAIN_RIG), 7.37)
    assert outcomes(result) == {"no_right_plane"}
