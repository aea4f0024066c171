"""What the simulator knows of a recording: which sequence it is, and the depth at any pixel and moment."""

from __future__ import annotations

import numpy as np

from velod.io.model import DepthTruth, Truth
from velod.sim.render import _cast_boxes, _cast_corridor, _cast_room
from velod.sim.sequences import TABLE_I, Sequence, sequence
from velod.types import F64, I64

_SAME_M = 1e-3
_ONE_PIXEL = np.array([[0, 1, 0, 1]], dtype=np.int64)


def true_depth(recipe: Sequence, t_ns: I64, x: F64, y: F64) -> F64:
    """Depth (m,) along the left camera's z, m, that each pixel ``x``, ``y`` (m,) sees at its time ``t_ns`` (m,).

    By ray casting, sub-pixel and exact, whatever the events were rendered at.
    """
    scene, camera = recipe.scene, recipe.calibration.left
    motion = recipe.trajectory.at(t_ns.astype(np.float64) * 1e-9)
    depth, surface = np.zeros((1, 1), np.float32), np.zeros((1, 1), np.int64)
    found = np.empty(len(t_ns))
    for k in range(len(t_ns)):
        # An image of one pixel, whose centre is at (x, y) of the camera's.
        pinhole = np.array([camera.fx, camera.fy, camera.cx - x[k], camera.cy - y[k]])
        pose = (pinhole, np.ascontiguousarray(motion.R_WB[k]), np.ascontiguousarray(motion.p_WB[k]))
        if len(scene.shell) == 3:
            _cast_corridor(scene.shell, *pose, _ONE_PIXEL, depth, surface)
        else:
            _cast_room(scene.shell, *pose, _ONE_PIXEL, depth, surface)
            _cast_boxes(scene.boxes, *pose, _ONE_PIXEL, depth, surface)
        found[k] = depth[0, 0]
    return found


def recipe_of(truth: Truth, depth: DepthTruth | None) -> Sequence | None:
    """The sequence whose motion and first depth image a recording holds; None where it is none of today's."""
    for name in TABLE_I:
        recipe = sequence(name)
        if _moves_so(recipe, truth) and depth is not None and _looks_so(recipe, depth):
            return recipe
    return None


def _moves_so(recipe: Sequence, truth: Truth) -> bool:
    at = np.linspace(0, len(truth.t_ns) - 1, 20).astype(np.int64)
    motion = recipe.trajectory.at(truth.t_ns[at].astype(np.float64) * 1e-9)
    return truth.p_WB is not None and bool(np.allclose(motion.p_WB, truth.p_WB[at], atol=_SAME_M))


def _looks_so(recipe: Sequence, depth: DepthTruth) -> bool:
    camera = recipe.calibration.left
    if depth.left.shape[1:] != (camera.height, camera.width):
        return False
    j, i = (a.ravel() for a in np.mgrid[5 : camera.height : 40, 5 : camera.width : 40])
    cast = true_depth(recipe, np.full(len(i), depth.t_ns[0]), i.astype(np.float64), j.astype(np.float64))
    return bool(np.allclose(cast, depth.left[0, j, i], rtol=1e-3))
