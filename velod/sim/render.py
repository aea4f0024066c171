"""Ray caster: depth and intensity of what a camera sees of a scene, in the areas of the image that are wanted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from velod.geometry.calibration import Camera
from velod.sim.cast import cast_shell_and_boxes, rays_of
from velod.sim.scene import Scene
from velod.sim.shade import MAX_ROW, shade
from velod.sim.texture import Texture
from velod.types import F32, F64, I64

I32 = NDArray[np.int32]


class Renderer:
    """One camera's view of a scene. ``depth`` (m, along z), ``surface`` and ``intensity`` (0..1) are (h, w)."""

    def __init__(self, scene: Scene, texture: Texture, camera: Camera) -> None:
        self._rays = rays_of(camera)
        self._scene = scene
        self._aimed: F32 = np.empty((len(scene.boxes), 19), np.float32)
        shape = (camera.height, camera.width)
        self.depth: F32 = np.zeros(shape, np.float32)
        self.surface: I32 = np.zeros(shape, np.int32)
        self.intensity: F32 = np.zeros(shape, np.float32)
        self._focal = np.array([camera.fx, camera.fy])
        self._texture = texture
        self._starts = texture.offset.astype(np.uint32)
        self._surfaces = scene.surfaces.astype(np.float32)
        if camera.width > MAX_ROW:
            raise ValueError(f"at most {MAX_ROW} rays can be cast in a row, got {camera.width}")
        self._work: F32 = np.empty(5 * MAX_ROW, np.float32)

    def render(self, R_WC: F64, p_WC: F64, areas: I64) -> None:
        """Bring ``areas`` up to date for a camera at ``p_WC`` (m, in W) with axes ``R_WC``.

        Each row of ``areas`` (m, 4) is one part of the image: [j0, j1, i0, i1], end exclusive.
        """
        R_WC, p_WC = np.ascontiguousarray(R_WC), np.ascontiguousarray(p_WC)
        self.cast(R_WC, p_WC, areas)
        shade(
            self._surfaces,
            self._texture.texels,
            self._texture.flat,
            self._starts,
            self._rays,
            self._focal,
            R_WC,
            p_WC,
            areas,
            self.depth,
            self.surface,
            self.intensity,
            self._work,
        )

    def cast(self, R_WC: F64, p_WC: F64, areas: I64) -> None:
        """As ``render``, but for the intensity, which stays as it was."""
        cast_shell_and_boxes(
            self._scene.shell,
            self._scene.boxes,
            np.ascontiguousarray(R_WC),
            np.ascontiguousarray(p_WC),
            self._rays,
            areas,
            self._aimed,
            1.0 / self._focal[0],
            self.depth,
            self.surface,
        )
