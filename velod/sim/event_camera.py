"""One event camera on its way through a scene: views as often as the image motion asks, tile by tile."""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.geometry.calibration import Camera
from velod.io.model import EventColumns
from velod.sim.events import EventModel, EventSensor
from velod.sim.render import Renderer
from velod.sim.scene import Scene
from velod.sim.texture import Texture
from velod.types import F32, F64, I64

MAX_MOTION_PX = 1.0
"""The largest image motion between two views of a pixel; in between, its log intensity runs linearly (ESIM)."""

BLOCK_STEPS = 12
"""A tile where all moves slowly is rendered every second, third, fourth, sixth or twelfth step only."""

TILE_PX = 16
_HALO_PX = 12  # what may move into a tile within BLOCK_STEPS steps
_STRIDE_PX = 4


class EventCamera:
    """Renderer and sensor of one camera, ``offset_B`` (3,) m from B's origin, with B's axes."""

    def __init__(
        self,
        scene: Scene,
        texture: Texture,
        camera: Camera,
        model: EventModel,
        offset_B: F64,
        rng: np.random.Generator,
    ) -> None:
        self._renderer = Renderer(scene, texture, camera)
        self._sensor = EventSensor(model, camera.width, camera.height, rng)
        self._camera = camera
        self._offset_B = offset_B
        self._tiles = _tiles(camera.width, camera.height)
        self._seen_us = np.zeros(len(self._tiles), np.int64)

    @property
    def depth(self) -> F32:
        """(h, w), m along z, as last rendered."""
        return self._renderer.depth

    def start(self, R_WB: F64, p_WB: F64) -> None:
        """Adapt to the first view, at t = 0."""
        self._renderer.render(R_WB, p_WB + R_WB @ self._offset_B, self._tiles)
        self._sensor.start(self._renderer.intensity)

    def tile_speeds(self, v_B: F64, omega_B: F64) -> F64:
        """Fastest image motion (px/s, Eq. 1) in and around each tile, for the depth as last rendered."""
        camera, speeds = self._camera, np.zeros(len(self._tiles))
        pinhole = np.array([camera.fx, camera.cx, camera.cy])
        _tile_speeds(self.depth, pinhole, v_B + np.cross(omega_B, self._offset_B), omega_B, self._tiles, speeds)
        return speeds

    def run(self, from_us: int, steps_us: list[int], poses: list[tuple[F64, F64]], every: I64) -> EventColumns:
        """Events of ``from_us < t <= steps_us[-1]``, with a pose (R_WB, p_WB) per step.

        Tile k is rendered every ``every[k]``-th step, and all tiles at the last step.
        """
        for k, (to_us, (R_WB, p_WB)) in enumerate(zip(steps_us, poses, strict=True), start=1):
            due = np.full(len(every), True) if k == len(steps_us) else k % every == 0
            areas = self._tiles[due]
            self._renderer.render(R_WB, p_WB + R_WB @ self._offset_B, areas)
            self._sensor.see(self._renderer.intensity, areas, self._seen_us[due], to_us)
            self._seen_us[due] = to_us
        return self._sensor.take(from_us, steps_us[-1])


def _tiles(width: int, height: int) -> I64:
    """Rows [j0, j1, i0, i1] of tiles that cover the image."""
    return np.array(
        [
            (j, min(j + TILE_PX, height), i, min(i + TILE_PX, width))
            for j in range(0, height, TILE_PX)
            for i in range(0, width, TILE_PX)
        ],
        dtype=np.int64,
    )


@njit(cache=True, nogil=True)
def _tile_speeds(depth: F32, pinhole: F64, v: F64, w: F64, tiles: I64, speeds: F64) -> None:
    f, cx, cy = pinhole
    height, width = depth.shape
    for m in range(tiles.shape[0]):
        fastest2 = 0.0
        for j in range(max(tiles[m, 0] - _HALO_PX, 0), min(tiles[m, 1] + _HALO_PX, height), _STRIDE_PX):
            for i in range(max(tiles[m, 2] - _HALO_PX, 0), min(tiles[m, 3] + _HALO_PX, width), _STRIDE_PX):
                x, y, z = i - cx, j - cy, depth[j, i]
                # Eq. 1
                dx = (-f * v[0] + x * v[2]) / z + x * y / f * w[0] - (f + x * x / f) * w[1] + y * w[2]
                dy = (-f * v[1] + y * v[2]) / z + (f + y * y / f) * w[0] - x * y / f * w[1] - x * w[2]
                fastest2 = max(fastest2, dx * dx + dy * dy)
        speeds[m] = np.sqrt(fastest2)
