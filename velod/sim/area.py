"""Views whose pixels gather light over their area, as a sensor's do, and not along one ray."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from velod.geometry.calibration import Camera
from velod.sim.render import Renderer
from velod.sim.scene import Scene
from velod.sim.texture import Texture
from velod.types import F32, F64, I64


def renderer_of(scene: Scene, texture: Texture, camera: Camera, side: int) -> Renderer | AreaRenderer:
    """What renders a camera's view with ``side`` x ``side`` rays a pixel."""
    return Renderer(scene, texture, camera) if side == 1 else AreaRenderer(scene, texture, camera, side)


class AreaRenderer:
    """As ``Renderer``, with the mean over ``side`` x ``side`` rays a pixel as its ``intensity``.

    One ray sees an outline jump from pixel to pixel: its events then tell the time of a view, not that of the
    outline. ``depth`` (h, w), m along z, is still that of the pixel's centre. Raises ValueError where ``side`` times
    the camera's width exceeds MAX_ROW.
    """

    def __init__(self, scene: Scene, texture: Texture, camera: Camera, side: int) -> None:
        self._side = side
        self._fine = Renderer(scene, texture, finer(camera, side))
        self._centre = Renderer(scene, texture, camera)
        self.depth: F32 = self._centre.depth
        self.intensity: F32 = self._centre.intensity  # which nothing else writes to

    def render(self, R_WC: F64, p_WC: F64, areas: I64) -> None:
        """Bring ``areas`` up to date for a camera at ``p_WC`` (m, in W) with axes ``R_WC``."""
        self._centre.cast(R_WC, p_WC, areas)
        self._fine.render(R_WC, p_WC, areas * self._side)
        mean_of_squares(self._fine.intensity, self._side, areas, self.intensity)


def finer(camera: Camera, side: int) -> Camera:
    """The camera with ``side`` x ``side`` pixels in the place of each."""
    half = (side - 1) / 2
    return replace(
        camera,
        width=camera.width * side,
        height=camera.height * side,
        fx=camera.fx * side,
        fy=camera.fy * side,
        cx=camera.cx * side + half,
        cy=camera.cy * side + half,
    )


@njit(cache=True, nogil=True)
def mean_of_squares(fine: F32, side: int, areas: I64, out: F32) -> None:
    """Each pixel of ``out`` (h, w) in ``areas`` is the mean of its square in ``fine`` (side h, side w)."""
    share = np.float32(1.0 / (side * side))
    for m in range(areas.shape[0]):
        for j in range(areas[m, 0], areas[m, 1]):
            for i in range(areas[m, 2], areas[m, 3]):
                total = np.float32(0.0)
                for b in range(side):
                    for a in range(side):
                        total += fine[j * side + b, i * side + a]
                out[j, i] = total * share
