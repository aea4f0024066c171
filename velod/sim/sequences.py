"""The simulated sequences by name: those of Table I, and others that no setting was chosen on."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from velod.sim.held_out import HELD_OUT
from velod.sim.recipe import Sequence
from velod.sim.scene import corridor, room, scatter_boxes
from velod.sim.texture import TextureRecipe
from velod.sim.trajectory import Harmonics, Trajectory
from velod.types import F64

# Fast turns sweep more of it past a pixel: fewer, larger leaves keep the event rate in bounds.
_ROOM_TEXTURE = TextureRecipe(leaves=1100, smallest_m=0.15, largest_m=1.0, darkest=0.12)
_SPIN_TEXTURE = TextureRecipe(leaves=500, smallest_m=0.22, largest_m=1.2, darkest=0.15)


class SequenceError(ValueError):
    """No sequence of that name; the text lists those that exist."""


# Table I: mean linear (m/s) and angular (rad/s) velocity.
TABLE_I = {
    "corridor-1": (5.68, 0.66),
    "corridor-2": (11.0, 1.45),
    "corridor-3": (18.9, 2.50),
    "boxes-4": (2.77, 2.05),
    "boxes-5": (3.19, 3.11),
    "spin-1": (2.17, 4.82),
    "spin-2": (4.94, 13.30),
    "spin-3": (4.84, 11.26),
}


def all_names() -> tuple[str, ...]:
    """Every sequence that there is."""
    return (*TABLE_I, *HELD_OUT)


def sequence(name: str, texture_seed: int | None = None) -> Sequence:
    """The sequence ``name``, with other leaves on its walls where a seed is given. Raises SequenceError."""
    if name not in all_names():
        raise SequenceError(f"unknown sequence {name!r}; known: {', '.join(all_names())}")
    recipe = HELD_OUT[name](name) if name in HELD_OUT else _of_table_i(name)
    if texture_seed is None:
        return recipe
    return replace(recipe, texture=replace(recipe.texture, seed=texture_seed))


def _of_table_i(name: str) -> Sequence:
    speed, rate = TABLE_I[name]
    kind = name.split("-")[0]
    if kind == "corridor":
        return _corridor(name, speed, rate)
    if kind == "boxes":
        return _boxes(name, speed, rate)
    return _spin(name, speed, rate)


def _corridor(name: str, speed: float, rate: float) -> Sequence:
    """Round and round, swaying gently: 3 m wide, 3 m high."""
    turn = 0.985 * rate  # the swaying adds the rest
    radius = 0.997 * speed / turn
    lap = 2.0 * math.pi
    position = (
        Harmonics(radius, 0.0, ((0.15, 0.41 * lap, 0.3),)),
        Harmonics(0.0, turn),
        Harmonics(1.5, 0.0, ((0.12, 0.53 * lap, 1.1),)),
    )
    trajectory = Trajectory(
        position,
        yaw=Harmonics(0.0, 0.0, ((0.04 * rate, 0.47 * lap, 0.0),)),
        pitch=Harmonics(0.0, 0.0, ((0.05 * rate, 0.61 * lap, 0.7),)),
        roll=Harmonics(0.0, 0.0, ((0.06 * rate, 0.37 * lap, 1.9),)),
        cylindrical=True,
    )
    return Sequence(name, trajectory, corridor(radius - 1.5, radius + 1.5, 3.0, seed=1))


def _boxes(name: str, speed: float, rate: float) -> Sequence:
    """Figures of eight through a room of 14 x 10 x 4 m, looking about."""
    size_m = (14.0, 10.0, 4.0)
    w = speed / 4.145
    position = (
        Harmonics(0.0, 0.0, ((4.0, w, 0.4),)),
        Harmonics(0.0, 0.0, ((2.2, 2.0 * w, 0.1),)),
        Harmonics(1.8, 0.0, ((0.5, 2.7 * w, 0.0),)),
    )
    k = rate / 1.5
    trajectory = Trajectory(
        position,
        yaw=Harmonics(0.2, 0.0, ((1.55 * k, 1.05, 0.0), (0.30 * k, 3.1, 1.0))),
        pitch=Harmonics(0.0, 0.0, ((0.28 * k, 3.3, 0.5), (0.10 * k, 6.1, 0.0))),
        roll=Harmonics(0.0, 0.0, ((0.30 * k, 2.9, 1.5),)),
    )
    keep_clear = trajectory.at(np.linspace(0.0, 60.0, 3000)).p_WB
    boxes = scatter_boxes(size_m, keep_clear, clearance_m=0.8, count=24, seed=4)
    return Sequence(name, trajectory, room(size_m, boxes, seed=4), _ROOM_TEXTURE)


def _spin(name: str, speed: float, rate: float) -> Sequence:
    """A stereo rig spun on a leash in a room of 9 x 6 x 3.5 m, looking outwards."""
    size_m = (9.0, 6.0, 3.5)
    turn = 0.998 * rate
    radius = speed / turn
    position = (
        Harmonics(radius, 0.0, ((0.08 * radius, 0.31 * turn, 0.0),)),
        Harmonics(0.0, turn),
        Harmonics(1.5, 0.0, ((0.15 * radius, 0.43 * turn, 0.8),)),
    )
    trajectory = Trajectory(
        position,
        yaw=Harmonics(-math.pi / 2, 0.0, ((0.1, 0.37 * turn, 0.0),)),
        pitch=Harmonics(0.0, 0.0, ((0.12, 0.53 * turn, 1.0),)),
        roll=Harmonics(0.0, 0.0, ((0.15, 0.47 * turn, 0.2),)),
        cylindrical=True,
    )
    keep_clear = trajectory.at(np.linspace(0.0, 30.0, 3000)).p_WB
    boxes = scatter_boxes(size_m, keep_clear, clearance_m=0.8, count=16, seed=6)
    return Sequence(name, trajectory, room(size_m, boxes, seed=6), _SPIN_TEXTURE)


def mean_motion(trajectory: Trajectory, seconds: float = 60.0) -> tuple[float, float]:
    """Mean |v| (m/s) and |omega| (rad/s) over ``seconds``, as Table I states them."""
    t_s: F64 = np.arange(0.0, seconds, 1e-3)
    motion = trajectory.at(t_s)
    return float(np.linalg.norm(motion.v_W, axis=1).mean()), float(np.linalg.norm(motion.omega_B, axis=1).mean())
