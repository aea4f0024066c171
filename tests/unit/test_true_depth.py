"""The simulator's depth at any pixel and moment, and which sequence a recording is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from velod.io import open_recording, read_depth
from velod.sim import sequence
from velod.sim.run import true_motion
from velod.sim.true_depth import recipe_of, true_depth


@pytest.mark.parametrize("name", ["corridor-1", "boxes-4"])
def test_the_depth_of_a_point_of_the_world_is_found_wherever_it_is_seen(name: str) -> None:
    """A point on a surface, by ray casting at one moment, has the depth of its projection a moment later."""
    recipe, t_ns = sequence(name), np.array([400_000_000, 410_000_000])
    camera, rng = recipe.calibration.left, np.random.default_rng(0)
    x, y = rng.uniform(40, 300, 60), rng.uniform(40, 220, 60)
    z = true_depth(recipe, np.full(60, t_ns[0]), x, y)
    now, then = (recipe.trajectory.at(t_ns[k : k + 1] * 1e-9) for k in (0, 1))
    points_C = np.stack([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z], axis=1)
    points_W = points_C @ now.R_WB[0].T + now.p_WB[0]
    later_C = (points_W - then.p_WB[0]) @ then.R_WB[0]
    u, v = (camera.fx * later_C[:, k] / later_C[:, 2] + c for k, c in ((0, camera.cx), (1, camera.cy)))
    again = true_depth(recipe, np.full(60, t_ns[1]), u, v)
    # A few points are hidden behind a box by then.
    assert np.mean(np.abs(again - later_C[:, 2]) < 1e-3 * later_C[:, 2]) > 0.9


def test_a_simulated_recording_is_recognised(simulated: Callable[[str, float], Path]) -> None:
    path = simulated("boxes-4", 0.6)
    recording = open_recording(path)
    assert recording.truth is not None
    recipe = recipe_of(recording.truth, read_depth(path))
    assert recipe is not None
    assert recipe.name == "boxes-4"


def test_a_motion_alone_does_not_make_a_simulated_recording(simulated: Callable[[str, float], Path]) -> None:
    depth = read_depth(simulated("boxes-4", 0.6))
    assert depth is not None
    truth = true_motion(sequence("boxes-4").trajectory, 0.6)
    depth.left[0] *= 1.1
    assert recipe_of(truth, depth) is None
    assert recipe_of(truth, None) is None
    assert recipe_of(true_motion(sequence("boxes-5").trajectory, 0.6), depth) is None
