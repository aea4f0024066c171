"""Motions of other kinds than Table I's, in other rooms and under other leaves, which no setting was chosen on.

They show whether settings hold elsewhere: a walk with stops, a start upside down, a flight that hovers and turns.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from velod.sim.recipe import Sequence
from velod.sim.scene import room, scatter_boxes
from velod.sim.texture import TextureRecipe
from velod.sim.trajectory import Harmonics, Trajectory
from velod.sim.waves import Waves, integral, power, product, scaled

_TEXTURE = TextureRecipe(leaves=1100, smallest_m=0.15, largest_m=1.0, darkest=0.12, seed=11)


def _walk(name: str) -> Sequence:
    """A rig in the hand of someone who goes round a room at up to 1.9 m/s, stops every four seconds, looks about."""
    goes = power((1.0, math.pi / 4.0, 0.0), 6)  # 0..1: at rest at t = 0, 4, 8, ... s, for a second and a half
    step_rad_s = 2.0 * math.pi * 1.8
    radius_m = 2.8
    trajectory = Trajectory(
        (
            Harmonics(radius_m, 0.0, _while_going(goes, 0.015, 0.5 * step_rad_s, 0.6)),
            integral(scaled(1.9 / radius_m, goes)),
            Harmonics(1.5, 0.0, (*_while_going(goes, 0.02, step_rad_s, 0.0), (0.01, 1.1, 0.2))),
        ),
        yaw=Harmonics(0.0, 0.0, ((0.5, 0.9, 0.3), *_while_going(goes, 0.03, 0.5 * step_rad_s, 0.0))),
        pitch=Harmonics(0.15, 0.0, ((0.08, 0.7, 1.0), *_while_going(goes, 0.02, step_rad_s, 0.4))),
        roll=Harmonics(0.0, 0.0, ((0.03, 0.8, 0.0), *_while_going(goes, 0.05, 0.5 * step_rad_s, 1.3))),
        cylindrical=True,
    )
    return _in_a_room(name, trajectory, (11.0, 9.0, 3.0), count=14, seed=21)


def _upside_down(name: str) -> Sequence:
    """A drone that starts on its back and rolls over and over on its way, at up to 4 m/s."""
    trajectory = Trajectory(
        (
            Harmonics(0.0, 0.0, ((3.2, 0.83, 1.1),)),
            Harmonics(0.0, 0.0, ((2.4, 1.21, 0.2),)),
            Harmonics(1.7, 0.0, ((0.6, 1.7, 0.0),)),
        ),
        yaw=Harmonics(0.4, 0.25, ((0.5, 1.3, 0.0),)),
        pitch=Harmonics(0.0, 0.0, ((0.35, 1.9, 0.8),)),
        roll=Harmonics(math.pi, 0.0, ((1.9, 1.5, 0.0),)),
    )
    return _in_a_room(name, trajectory, (12.0, 9.0, 3.8), count=18, seed=22)


def _hover(name: str) -> Sequence:
    """A drone that dashes at up to 4.5 m/s, hovers and turns on the spot at up to 2 rad/s, and dashes back."""
    w = math.pi / 2.5  # a dash every 2.5 s
    dashes, turns = power((1.0, w, 0.0), 5), product(((1.0, 0.3 * w, 1.0),), power((1.0, w, 0.5 * math.pi), 4))
    across = product(dashes, ((1.0, 0.4 * w, 0.5),))
    shake = (0.004, 2.0 * math.pi * 6.0, 0.0)  # the air is never quite still
    trajectory = Trajectory(
        (
            integral(scaled(3.6, dashes), start=-2.0),
            integral(scaled(2.7, across), start=-0.5),
            Harmonics(1.6, 0.0, ((0.25, 0.37, 0.0), shake)),
        ),
        yaw=integral(scaled(2.0, turns)),
        pitch=Harmonics(0.0, 0.0, ((0.1, w, 1.2), shake)),
        roll=Harmonics(0.0, 0.0, ((0.08, 0.5 * w, 0.4), shake)),
    )
    return _in_a_room(name, trajectory, (12.0, 11.0, 3.6), count=16, seed=23)


HELD_OUT: dict[str, Callable[[str], Sequence]] = {
    "walk-1": _walk,
    "flip-1": _upside_down,
    "hover-1": _hover,
}
"""Name -> what makes the sequence of that name."""


def _while_going(goes: Waves, amplitude: float, w: float, phase: float) -> Waves:
    """A wave that rests when the walk does."""
    return product(goes, ((amplitude, w, phase),))


def _in_a_room(
    name: str, trajectory: Trajectory, size_m: tuple[float, float, float], count: int, seed: int
) -> Sequence:
    keep_clear = trajectory.at(np.linspace(0.0, 60.0, 3000)).p_WB
    boxes = scatter_boxes(size_m, keep_clear, clearance_m=0.8, count=count, seed=seed)
    return Sequence(name, trajectory, room(size_m, boxes, seed=seed), _TEXTURE)
