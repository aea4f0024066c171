"""What the simulator knows of a recording: which sequence it is, and the depth along any ray at any moment."""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.geometry.calibration import Calibration, Camera
from velod.geometry.camera import normalised, undistort
from velod.geometry.rectify import Rectification
from velod.io.model import DepthTruth, Truth
from velod.sim.cast import cast_shell_and_boxes
from velod.sim.recipe import Sequence
from velod.sim.scene import Scene
from velod.sim.sequences import all_names, sequence
from velod.types import F32, F64, I64

_SAME_M = 1e-3


class CastDepth:
    """Ray casting into a sequence's scene: exact at any moment and sub-pixel."""

    how = "ray casting at each event's own time"

    def __init__(self, recipe: Sequence, rectification: Rectification) -> None:
        self._recipe, self._rectification = recipe, rectification

    def __call__(self, t_ns: I64, rays: F64, shift_m: float = 0.0) -> F64:
        """Depth (m, k), m along z of C, at times ``t_ns`` (m,) along ``rays`` (m, k, 2), x and y on its plane Z = 1.

        ``shift_m``: the camera moved so far along C's x axis; the baseline gives what the right camera sees.
        """
        rect = self._rectification
        motion = self._recipe.trajectory.at(t_ns.astype(np.float64) * 1e-9)
        R_WC = motion.R_WB @ rect.R_CB.T
        p_WC = motion.p_WB + motion.R_WB @ rect.p_BC_B + shift_m * R_WC[:, :, 0]
        return cast_rays(self._recipe.scene, R_WC, p_WC, rays)


def cast_rays(scene: Scene, R_WC: F64, p_WC: F64, rays: F64) -> F64:
    """Depth (m, k), m along each camera's z, for cameras R_WC (m, 3, 3), p_WC (m, 3) and their rays (m, k, 2)."""
    depth = np.empty(rays.shape[:2], np.float32)
    per_image = np.ascontiguousarray(rays.transpose(0, 2, 1)[:, :, None, :], dtype=np.float32)
    _cast_each(scene.shell, scene.boxes, np.ascontiguousarray(R_WC), np.ascontiguousarray(p_WC), per_image, depth)
    return depth.astype(np.float64)


@njit(cache=True, nogil=True)
def _cast_each(shell: F64, boxes: F64, R_WC: F64, p_WC: F64, rays: F32, depth: F32) -> None:
    """Every camera takes an image of one row: ``rays`` (m, 2, 1, k)."""
    k = depth.shape[1]
    area = np.array([[0, 1, 0, k]])
    aimed = np.empty((boxes.shape[0], 19), np.float32)
    row, surface = np.empty((1, k), np.float32), np.empty((1, k), np.int32)
    for m in range(depth.shape[0]):
        # The rays of one event may lie anywhere: no box may be left out for where its image is.
        cast_shell_and_boxes(shell, boxes, R_WC[m], p_WC[m], rays[m], area, aimed, np.inf, row, surface)
        depth[m] = row[0]


def recipe_of(calibration: Calibration, truth: Truth, depth: DepthTruth | None) -> Sequence | None:
    """The sequence whose motion and first depth image a recording holds; None where it is none of today's."""
    for name in all_names():
        recipe = sequence(name)
        if _moves_so(recipe, truth) and depth is not None and _looks_so(recipe, calibration.left, depth):
            return recipe
    return None


def _moves_so(recipe: Sequence, truth: Truth) -> bool:
    at = np.linspace(0, len(truth.t_ns) - 1, 20).astype(np.int64)
    motion = recipe.trajectory.at(truth.t_ns[at].astype(np.float64) * 1e-9)
    return truth.p_WB is not None and bool(np.allclose(motion.p_WB, truth.p_WB[at], atol=_SAME_M))


def _looks_so(recipe: Sequence, camera: Camera, depth: DepthTruth) -> bool:
    if depth.left.shape[1:] != (camera.height, camera.width):
        return False
    j, i = (a.ravel() for a in np.mgrid[5 : camera.height : 40, 5 : camera.width : 40])
    rays = undistort(normalised(np.stack([i, j], axis=1).astype(np.float64), camera), camera)
    start = recipe.trajectory.at(depth.t_ns[:1].astype(np.float64) * 1e-9)
    cast = cast_rays(recipe.scene, start.R_WB, start.p_WB, rays[None])[0]
    return bool(np.allclose(cast, depth.left[0, j, i], rtol=1e-3))
