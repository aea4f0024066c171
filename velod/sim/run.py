"""Record a sequence: the events of both cameras, IMU samples, and the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from velod.geometry.so3 import quaternion_from_matrix
from velod.io.model import NO_EVENTS, DepthTruth, EventColumns, Truth
from velod.io.sequence import RecordingWriter
from velod.sim.effects import Readout
from velod.sim.event_camera import BLOCK_STEPS, MAX_MOTION_PX, STEPS, EventCamera
from velod.sim.imu import sample_imu
from velod.sim.recipe import BASELINE_M, Sequence
from velod.sim.sequences import SequenceError
from velod.sim.texture import make_texture
from velod.sim.trajectory import Trajectory
from velod.types import F32, F64

Progress = Callable[[float], None]
"""Called with the share that is done, 0..1."""

_STEP_US = (7, 700)
_DEPTH_PERIOD_US = 100_000


def simulate(
    sequence: Sequence,
    seconds: float,
    seed: int,
    path: str | Path,
    progress: Progress | None = None,
) -> None:
    """Write ``seconds`` of ``sequence`` to ``path``; on one machine equal arguments give equal bytes.

    The two cameras are rendered in two threads. Raises SequenceError for less than a microsecond, RecordingError
    where the file cannot be written.
    """
    imu_rng, left_rng, right_rng, *clock_rngs = (np.random.default_rng((seed, k)) for k in range(5))
    end_us = round(seconds * 1e6)
    if end_us < 1:
        raise SequenceError(f"{seconds:g} s are less than a microsecond")
    depths: list[F32] = []
    effects = sequence.effects
    left, right = (
        Readout(effects, offset_us, rng)
        for offset_us, rng in zip((0, effects.clock_offset_us), clock_rngs, strict=True)
    )
    with RecordingWriter(path, sequence.calibration) as writer:
        for block in _render(sequence, end_us, left_rng, right_rng):
            writer.append("left", left.read(block.left, block.t_us))
            writer.append("right", right.read(block.right, block.t_us))
            if block.depth is not None:
                depths.append(block.depth)
            if progress is not None:
                progress(block.t_us / end_us)
        writer.append("left", left.read(NO_EVENTS, None))
        writer.append("right", right.read(NO_EVENTS, None))
        writer.finish(
            sample_imu(sequence.trajectory, sequence.imu, seconds, imu_rng),
            true_motion(sequence.trajectory, seconds),
            DepthTruth(np.arange(len(depths), dtype=np.int64) * _DEPTH_PERIOD_US * 1000, np.array(depths)),
        )


def true_motion(trajectory: Trajectory, seconds: float) -> Truth:
    """The truth at 1 kHz, both ends included."""
    t_us = np.arange(0, round(seconds * 1e6) + 1, 1000, dtype=np.int64)
    motion = trajectory.at(t_us / 1e6)
    return Truth(t_us * 1000, motion.v_B, motion.omega_B, quaternion_from_matrix(motion.R_WB), motion.p_WB)


@dataclass(frozen=True, slots=True)
class _Block:
    """Events up to and including ``t_us``, and the left depth image at ``t_us`` if one is due."""

    t_us: int
    left: EventColumns
    right: EventColumns
    depth: F32 | None


def _render(
    sequence: Sequence, end_us: int, left_rng: np.random.Generator, right_rng: np.random.Generator
) -> Iterator[_Block]:
    """Both cameras along the trajectory, in blocks of BLOCK_STEPS steps.

    A step is so short that nothing in either image moves more than MAX_MOTION_PX.
    """
    scene, camera, texture = sequence.scene, sequence.calibration.left, make_texture(sequence.texture)
    effects = sequence.effects
    left, right = (
        EventCamera(
            scene, texture, camera, sequence.events, effects, np.array([x_m, 0.0, 0.0]), rng, sequence.rays_per_side
        )
        for x_m, rng in ((0.0, left_rng), (BASELINE_M, right_rng))
    )
    at_us = 0
    R_WB, p_WB, v_B, omega_B = _pose(sequence.trajectory, at_us)
    for eye in (left, right):
        eye.start(R_WB, p_WB)
    yield _Block(at_us, NO_EVENTS, NO_EVENTS, left.depth.copy())
    with ThreadPoolExecutor(2) as pool:
        while at_us < end_us:
            speeds = [eye.tile_speeds(v_B, omega_B) for eye in (left, right)]
            fastest = max(float(speed.max()) for speed in speeds)
            step_us = int(np.clip(MAX_MOTION_PX * 1e6 / STEPS / max(fastest, 1e-3), *_STEP_US))
            # Depth images are due at whole periods, at the end of a block.
            until_us = min(at_us - at_us % _DEPTH_PERIOD_US + _DEPTH_PERIOD_US, end_us)
            steps_us = list(range(at_us + step_us, until_us, step_us))[: BLOCK_STEPS - 1]
            steps_us.append(min(at_us + (len(steps_us) + 1) * step_us, until_us))
            motion = sequence.trajectory.at(np.array(steps_us) / 1e6)
            jobs = [
                pool.submit(eye.run, at_us, steps_us, motion.R_WB, motion.p_WB, speed * step_us * 1e-6)
                for eye, speed in zip((left, right), speeds, strict=True)
            ]
            seen_left, seen_right = (job.result() for job in jobs)
            at_us = steps_us[-1]
            yield _Block(at_us, seen_left, seen_right, left.depth.copy() if at_us % _DEPTH_PERIOD_US == 0 else None)
            _, _, v_B, omega_B = _pose(sequence.trajectory, at_us)


def _pose(trajectory: Trajectory, t_us: int) -> tuple[F64, F64, F64, F64]:
    """R_WB, p_WB, v_B, omega_B."""
    motion = trajectory.at(np.array([t_us / 1e6]))
    return motion.R_WB[0], motion.p_WB[0], motion.v_B[0], motion.omega_B[0]
