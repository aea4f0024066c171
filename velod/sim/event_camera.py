"""One event camera on its way through a scene: views as often as the image motion asks, tile by tile."""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.geometry.calibration import Camera
from velod.io.model import EventColumns
from velod.sim.area import renderer_of
from velod.sim.effects import Effects
from velod.sim.events import EventModel, EventSensor
from velod.sim.scene import Scene
from velod.sim.texture import Texture
from velod.types import F32, F64, I64

MAX_MOTION_PX = 1.0
"""The largest image motion between two views of a pixel; in between, its log intensity runs linearly (ESIM)."""

STEPS = 3
"""Steps per MAX_MOTION_PX of the fastest tile, so that slower ones too come close to it between their views."""

BLOCK_STEPS = 12 * STEPS
"""Steps until all tiles are rendered and the depth that decides about the motion is known anew."""

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
        effects: Effects,
        offset_B: F64,
        rng: np.random.Generator,
        rays_per_side: int,
    ) -> None:
        self._renderer = renderer_of(scene, texture, camera, rays_per_side)
        self._sensor = EventSensor(model, effects, camera.width, camera.height, rng)
        self._camera = camera
        self._offset_B = offset_B
        self._tiles = _tiles(camera.width, camera.height)
        self._seen_us = np.zeros(len(self._tiles), np.int64)
        self._joined = np.empty_like(self._tiles)

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

    def run(self, from_us: int, steps_us: list[int], R_WB: F64, p_WB: F64, motion_px: F64) -> EventColumns:
        """Events of ``from_us < t <= steps_us[-1]``, with a pose R_WB (n, 3, 3), p_WB (n, 3) per step.

        ``motion_px`` (tiles,): within a step. A tile is rendered when MAX_MOTION_PX is up, and at the last step.
        """
        p_WC = p_WB + R_WB @ self._offset_B
        every = np.maximum(MAX_MOTION_PX / np.maximum(motion_px, 1e-9), 1.0).astype(np.int64)
        for k, to_us in enumerate(steps_us):
            due = np.flatnonzero((k + 1) % every == 0) if k + 1 < len(steps_us) else np.arange(len(every))
            if len(due) == 0:
                continue
            joined = self._joined[: _join(self._tiles, due, self._joined)]
            self._renderer.render(R_WB[k], p_WC[k], joined)
            self._sensor.see(self._renderer.intensity, self._tiles[due], self._seen_us[due], to_us)
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
def _join(tiles: I64, due: I64, areas: I64) -> int:
    """Fill ``areas`` with runs of neighbours in a row of tiles: long rows render faster. Returns their number."""
    n = 0
    for k in range(due.shape[0]):
        j0, j1, i0, i1 = tiles[due[k]]
        if n > 0 and areas[n - 1, 0] == j0 and areas[n - 1, 3] == i0:
            areas[n - 1, 3] = i1
        else:
            areas[n, 0], areas[n, 1], areas[n, 2], areas[n, 3] = j0, j1, i0, i1
            n += 1
    return n


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
