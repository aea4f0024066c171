"""What decides about a simulated recording."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from velod.geometry.calibration import Calibration, Camera
from velod.sim.effects import Effects, SensorError
from velod.sim.events import EventModel
from velod.sim.imu import ImuModel
from velod.sim.scene import Scene
from velod.sim.shade import MAX_ROW
from velod.sim.texture import TextureRecipe
from velod.sim.trajectory import Trajectory

BASELINE_M = 0.12

_MAX_RAYS_PER_SIDE = 4


@dataclass(frozen=True, slots=True)
class Sequence:
    """All that decides what is recorded, but for length and seed."""

    name: str
    trajectory: Trajectory
    scene: Scene
    texture: TextureRecipe = field(default_factory=TextureRecipe)
    events: EventModel = field(default_factory=EventModel)
    effects: Effects = field(default_factory=Effects)
    imu: ImuModel = field(default_factory=ImuModel)
    sensor: tuple[int, int] = (346, 260)  # columns and rows of both cameras
    rays_per_side: int = 1  # a pixel's light is the mean over so many rays squared, evenly over its area

    def __post_init__(self) -> None:
        """Raises SensorError."""
        rays, width = self.rays_per_side, self.sensor[0]
        if not 1 <= rays <= _MAX_RAYS_PER_SIDE:
            raise SensorError(f"rays along a pixel's side must be 1 to {_MAX_RAYS_PER_SIDE}, got {rays}")
        if rays * width > MAX_ROW:
            raise SensorError(
                f"at most {MAX_ROW} rays can be cast in a row, got {width} pixels times {rays} = {rays * width}"
            )

    @property
    def calibration(self) -> Calibration:
        """A pair of cameras that look the same way; left camera = body = IMU. Undistorted but for the effects.

        Whatever the sensor's size, it sees as much of the scene from left to right as a DAVIS346.
        """
        radtan = self.effects.radtan
        width, height = self.sensor
        f = 231.5 * width / 346
        model = "radtan" if radtan else "none"
        camera = Camera(width, height, f, f, (width - 1) / 2, (height - 1) / 2, model, radtan)
        return Calibration(camera, camera, np.eye(3), np.array([-BASELINE_M, 0.0, 0.0]))
