"""What a recording holds, in memory: event columns, IMU, truth, and the error of every reader."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from velod.geometry.calibration import Calibration
from velod.types import F32, F64, I64, U8, U16


class RecordingError(ValueError):
    """A recording that cannot be used; one line that names the file and the cause."""


@dataclass(frozen=True, slots=True)
class EventColumns:
    """Events of one camera in sensor pixels, in time order."""

    t_ns: I64  # (n,) sensor time, non-decreasing
    x: U16  # (n,) column, px
    y: U16  # (n,) row, px
    p: U8  # (n,) 1 = ON, 0 = OFF


NO_EVENTS = EventColumns(np.empty(0, np.int64), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.uint8))


@dataclass(frozen=True, slots=True)
class Imu:
    """IMU samples of a recording."""

    t_ns: I64  # (n,) sensor time, increasing
    accel: F64  # (n, 3) specific force, m/s^2, frame B (+9.81 upwards at rest)
    gyro: F64  # (n, 3) angular velocity, rad/s, frame B


@dataclass(frozen=True, slots=True)
class Truth:
    """True motion of the body (the IMU's origin); only the evaluation may see it."""

    t_ns: I64  # (n,) increasing
    v_B: F64  # (n, 3) linear velocity, m/s, frame B
    omega_B: F64  # (n, 3) angular velocity, rad/s, frame B
    q_WB_xyzw: F64  # (n, 4) attitude, W from B
    p_WB: F64 | None = None  # (n, 3) position of B's origin in W, m


@dataclass(frozen=True, slots=True)
class DepthTruth:
    """True depth images of the left camera (along z), as a simulator gives them."""

    t_ns: I64  # (m,)
    left: F32  # (m, height, width), m


@dataclass(frozen=True, slots=True)
class SequenceData:
    """All of a sequence in memory: what a simulator returns and ``write_recording`` stores."""

    calibration: Calibration
    left: EventColumns
    right: EventColumns
    imu: Imu
    truth: Truth | None = None
    depth: DepthTruth | None = None


class EventSource(Protocol):
    """The events of one camera, wherever they are stored, read block by block."""

    @property
    def name(self) -> str:
        """For errors: file and dataset."""
        ...

    @property
    def n_events(self) -> int:
        """How many there are."""
        ...

    @property
    def first_t_ns(self) -> int:
        """Sensor time of the first event, 0 without events."""
        ...

    @property
    def last_t_ns(self) -> int:
        """Sensor time of the last event, 0 without events."""
        ...

    def blocks(self) -> Iterator[EventColumns]:
        """Consecutive blocks in file order. Raises RecordingError where the file cannot be read."""
        ...


class Parts(NamedTuple):
    """What every reader finds in a recording."""

    calibration: Calibration
    left: EventSource
    right: EventSource
    imu: Imu
    truth: Truth | None
