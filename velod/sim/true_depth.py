"""What the simulator knows of a recording: which sequence it is, and the depth at any pixel and moment."""

from __future__ import annotations

import numpy as np

from velod.geometry.camera import normalised, undistort
from velod.io.model import DepthTruth, Truth
from velod.sim.render import Caster
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
    found = np.empty(len(t_ns))
    rays = np.empty((2, 1, 1), np.float32)
    caster = Caster(scene, rays, camera.fx)
    looks = undistort(normalised(np.stack([x, y], axis=1), camera), camera)
    for k in range(len(t_ns)):
        # An image of one pixel, which looks where (x, y) of the camera's does.
        rays[:, 0, 0] = looks[k]
        caster.cast(np.ascontiguousarray(motion.R_WB[k]), np.ascontiguousarray(motion.p_WB[k]), _ONE_PIXEL)
        found[k] = caster.depth[0, 0]
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
