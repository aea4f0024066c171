"""True depth: by ray casting into the simulator's scenes, and by depth images that are carried to any moment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from velod.eval.judged_events import AROUND, beside_jump
from velod.eval.scene_truth import DepthImages, SceneTruthError, rays
from velod.geometry.calibration import Calibration
from velod.geometry.rectify import rectify
from velod.io import open_recording, read_depth
from velod.io.model import DepthTruth, Truth
from velod.sim import sequence
from velod.sim.run import true_motion
from velod.sim.true_depth import CastDepth, recipe_of


def rig(name: str) -> Calibration:
    return sequence(name).calibration


@pytest.mark.parametrize("name", ["corridor-1", "boxes-4"])
def test_the_depth_of_a_point_of_the_world_is_found_wherever_it_is_seen(name: str) -> None:
    """A point on a surface, by ray casting at one moment, has the depth of its projection a moment later."""
    recipe, t_ns = sequence(name), np.array([400_000_000, 410_000_000])
    rect, rng = rectify(recipe.calibration), np.random.default_rng(0)
    true_depth = CastDepth(recipe, rect)
    look = rays(rect, rng.uniform(40, 300, 60), rng.uniform(40, 220, 60))
    z = true_depth(t_ns[:1], look[None])[0]
    now, then = (recipe.trajectory.at(t_ns[k : k + 1] * 1e-9) for k in (0, 1))
    points_W = np.column_stack([look * z[:, None], z]) @ now.R_WB[0].T + now.p_WB[0]
    later_C = (points_W - then.p_WB[0]) @ then.R_WB[0]
    again = true_depth(t_ns[1:], (later_C[:, :2] / later_C[:, 2:])[None])[0]
    # A few points are hidden behind a box by then.
    assert np.mean(np.abs(again - later_C[:, 2]) < 1e-3 * later_C[:, 2]) > 0.9


def test_the_right_camera_sees_a_point_where_its_disparity_says() -> None:
    recipe, rng = sequence("boxes-4"), np.random.default_rng(1)
    rect, t_ns = rectify(recipe.calibration), np.array([300_000_000])
    true_depth = CastDepth(recipe, rect)
    x, y = rng.uniform(80, 330, 200), rng.uniform(20, 240, 200)
    z = true_depth(t_ns, rays(rect, x, y)[None])[0]
    disparity = rect.f * rect.baseline_m / z
    right = true_depth(t_ns, rays(rect, x - disparity, y)[None], rect.baseline_m)[0]
    # What only the left camera sees is hidden behind something nearer.
    assert np.mean(np.abs(right - z) < 1e-4 * z) > 0.9
    assert (right < 1.0001 * z).all()


@pytest.mark.parametrize("name", ["corridor-1", "boxes-4"])
def test_depth_images_carried_to_another_moment_agree_with_ray_casting(
    name: str, simulated: Callable[[str, float], Path]
) -> None:
    path = simulated(name, 0.6)
    recording, images, rng = open_recording(path), read_depth(path), np.random.default_rng(2)
    assert recording.truth is not None and images is not None
    rect = rectify(recording.calibration)
    t_ns = rng.integers(0, 600_000_000, 4000)
    look = rays(rect, rng.uniform(0, rect.width - 1, 4000), rng.uniform(0, rect.height - 1, 4000))[:, None]
    cast = CastDepth(sequence(name), rect)(t_ns, look)
    carried = DepthImages(images, recording.truth, recording.calibration, rect)(t_ns, look)
    known = np.isfinite(carried)
    assert known.mean() > 0.9
    off = np.abs(carried / cast - 1.0)[known]
    assert np.percentile(off, 95) < 2e-4
    # The rest looks past an edge of a box that was elsewhere when the image was taken.
    assert np.mean(off > 0.01) < 0.005


def slanted_wall(jump: bool = False) -> tuple[DepthTruth, Truth, Calibration]:
    """A camera that moves sideways at 1 m/s past a slanted wall; with a nearer one in the right half."""
    calibration = rig("boxes-4")
    camera, t_ns = calibration.left, np.array([0, 100_000_000])
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    # Z = 2 + X / 4 at the first image, with X counted from it.
    rows = [(2.0 + 0.25 * 0.1 * k) / (1.0 - 0.25 * x) for k in (0, 1)]
    if jump:
        rows = [np.where(x > 0.2, 1.0, row) for row in rows]
    images = np.repeat(np.array(rows, np.float32)[:, None], camera.height, axis=1)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    v_B = np.tile([1.0, 0.0, 0.0], (2, 1))
    p_WB = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    return DepthTruth(t_ns, images), Truth(t_ns, v_B, np.zeros((2, 3)), still, p_WB), calibration


def test_between_two_images_the_depth_of_a_slanted_wall_is_the_analytic_one() -> None:
    images, truth, calibration = slanted_wall()
    true_depth = DepthImages(images, truth, calibration, rectify(calibration))
    t_ns = np.array([10_000_000, 47_000_000, 90_000_000])
    look = np.tile([[0.1, 0.2], [-0.3, 0.0]], (3, 1, 1))
    expected = (2.0 + 0.25 * t_ns[:, None] * 1e-9) / (1.0 - 0.25 * look[..., 0])
    np.testing.assert_allclose(true_depth(t_ns, look), expected, rtol=1e-6)


def test_beside_a_jump_and_outside_the_images_nothing_is_known() -> None:
    images, truth, calibration = slanted_wall(jump=True)
    images = DepthTruth(images.t_ns[:1], images.left[:1])
    rect = rectify(calibration)
    true_depth = DepthImages(images, truth, calibration, rect)
    edge_px = calibration.left.cx + 0.2 * calibration.left.fx
    look = rays(rect, np.array([[100.0, edge_px, -30.0]]), np.array([[50.0, 50.0, 50.0]]))
    known = np.isfinite(true_depth(np.array([0]), look))
    np.testing.assert_array_equal(known, [[True, False, False]])


def test_depth_images_need_a_position_and_a_plain_camera() -> None:
    images, truth, calibration = slanted_wall()
    rect = rectify(calibration)
    with pytest.raises(SceneTruthError, match="position"):
        DepthImages(images, replace(truth, p_WB=None), calibration, rect)
    lens = replace(calibration.left, model="equi", dist=(0.1, 0.0, 0.0, 0.0))
    with pytest.raises(SceneTruthError, match="undistorted"):
        DepthImages(images, truth, replace(calibration, left=lens, right=lens), rect)


def test_a_simulated_recording_is_recognised(simulated: Callable[[str, float], Path]) -> None:
    path = simulated("boxes-4", 0.6)
    recording = open_recording(path)
    assert recording.truth is not None
    recipe = recipe_of(recording.calibration, recording.truth, read_depth(path))
    assert recipe is not None
    assert recipe.name == "boxes-4"


def test_a_motion_alone_does_not_make_a_simulated_recording(simulated: Callable[[str, float], Path]) -> None:
    depth, calibration = read_depth(simulated("boxes-4", 0.6)), rig("boxes-4")
    assert depth is not None
    truth = true_motion(sequence("boxes-4").trajectory, 0.6)
    depth.left[0] *= 1.1
    assert recipe_of(calibration, truth, depth) is None
    assert recipe_of(calibration, truth, None) is None
    assert recipe_of(calibration, true_motion(sequence("boxes-5").trajectory, 0.6), depth) is None


@pytest.mark.parametrize(
    ("depths", "jump"),
    [
        (1.0 / (0.3 + 0.05 * AROUND[:, 0] + 0.03 * AROUND[:, 1]), False),  # a plane that leans by 53 % over 5 px
        (np.where(AROUND[:, 0] > 0, 3.0 * 1.07, 3.0), True),
        (np.where(AROUND[:, 0] >= 0, 3.0 * 1.03, 3.0), False),
        (np.where(AROUND[:, 1] == 0, 3.0, 2.7), True),  # a pole
        (np.where(AROUND.sum(axis=1) == 2, np.nan, 3.0), True),
    ],
)
def test_a_jump_of_depth_is_what_no_plane_is_however_it_leans(depths: np.ndarray, jump: bool) -> None:
    assert beside_jump(depths[None]).tolist() == [jump]
