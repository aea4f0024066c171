"""What decides about a simulated recording."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from velod.geometry.calibration import Calibration, Camera
from velod.sim.effects import Effects
from velod.sim.events import EventModel
from velod.sim.imu import ImuModel
from velod.sim.scene import Scene
from velod.sim.texture import TextureRecipe
from velod.sim.trajectory import Trajectory

BASELINE_M = 0.12


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

    @property
    def calibration(self) -> Calibration:
        """A pair of DAVIS346 that look the same way; left camera = body = IMU. Undistorted but for the effects."""
        radtan = self.effects.radtan
        camera = Camera(346, 260, 231.5, 231.5, 172.5, 129.5, "radtan" if radtan else "none", radtan)
        return Calibration(camera, camera, np.eye(3), np.array([-BASELINE_M, 0.0, 0.0]))
