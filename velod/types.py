"""The arrays that flow: what each message holds, with dtype, shape, unit and frame.

Conventions (all messages):

* ``seq`` counts the messages of one publisher from 0; a value lower than the one before means that the
  publisher was restarted.
* ``t_ns`` is sensor time in integer nanoseconds; what it marks is said for each message.
* Columns are contiguous numpy arrays of one length ``n`` in the first axis.
* ``x`` is the column and ``y`` the row of a pixel; pixel centres are at integers.
* An *age* is ``batch.t_ns - event time`` in ns, at least 1; 0 means "no event within the memory".

Frames: ``B`` body = IMU; ``C`` = the *rectified* left camera (x right, y down, z forward); ``W`` world, z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

NS_PER_S = 1_000_000_000
PATCH = 5
"""Side of the neighbourhood of the plane fit, in pixels (Sec. V-A: 5 x 5)."""
WIDE = 7
"""Side of the neighbourhood that a fitted plane is widened to, in pixels."""
RING = WIDE * WIDE - PATCH * PATCH
"""Neighbours of the 7x7 around the 5x5."""


@dataclass(frozen=True, slots=True)
class EventPacket:
    """Raw events of one camera, as a driver publishes them, in sensor pixels.

    ``t_ns`` is a watermark: every event of this camera earlier than it has been sent in this packet or an
    earlier one, and later packets hold only events at ``t_ns`` or later. It is at least the time of the last
    event. A packet without events is allowed, and moves the watermark alone (a static scene).
    """

    seq: int
    t_ns: int
    camera: str  # "left" | "right"
    x: U16  # (n,) column, px
    y: U16  # (n,) row, px
    event_t_ns: I64  # (n,) sensor time, non-decreasing
    p: U8  # (n,) polarity, 1 = ON, 0 = OFF


@dataclass(frozen=True, slots=True)
class ImuPacket:
    """IMU samples as a driver publishes them; ``t_ns`` is the time of the last sample."""

    seq: int
    t_ns: int
    sample_t_ns: I64  # (n,) sensor time, increasing
    accel: F64  # (n, 3) specific force, m/s^2, frame B (+9.81 upwards at rest)
    gyro: F64  # (n, 3) angular velocity, rad/s, frame B


@dataclass(frozen=True, slots=True)
class EventBatch:
    """Selected left events with their neighbourhoods on the surface of active events: ingest -> flow.

    The batch spans the left events with ``t_start_ns <= t < t_ns``; ``t_ns`` is its (exclusive) end. A selected event
    may be older than ``t_start_ns``, by up to half the memory: it is selected in the batch that completes its
    neighbourhood.

    Event by event (``ingest.mode``) a batch comes in several parts: ``t_ns`` is the end of the part, ``t_start_ns``
    the start of the batch, and ``n_events`` counts those since the part before.
    """

    seq: int
    t_ns: int
    t_start_ns: int
    n_events: int  # left events in the batch before selection
    x: U16  # (n,) sensor px, left camera
    y: U16  # (n,) sensor px
    age: U32  # (n,) ns before t_ns, >= 1
    p: U8  # (n,) 1 = ON, 0 = OFF
    patch: U32  # (n, 25) ages (ns) of the 5x5 same-polarity neighbours, row-major, 0 = none
    batch_seq: int = -1  # of the StereoBatch that carries the same events; -1: seq itself
    first: int = 0  # position there of the first event
    ring: U32 = field(default_factory=lambda: np.empty((0, RING), np.uint32))
    """(n, 24) likewise the rest of the 7x7, row-major without the 5x5; (0, 24): not known, or not wanted"""
    time_noise_ns: int = 0  # standard deviation of the time stamps' errors, as far as known


@dataclass(frozen=True, slots=True)
class StereoBatch:
    """The same selected events with the surfaces of both cameras at the batch's end: ingest -> depth.

    A surface cell is an age in steps of ``unit_ns`` (1 .. 65535), 0 where nothing happened within the memory.
    """

    seq: int
    t_ns: int
    t_start_ns: int
    unit_ns: int
    x: U16  # (n,) as in the EventBatch of the same seq, or in all those of this batch_seq
    y: U16  # (n,)
    age: U32  # (n,) ns
    p: U8  # (n,)
    left: U16  # (2, h, w) first-of-burst SAE per polarity (0 = OFF, 1 = ON), left sensor grid
    right: U16  # (2, h, w) right sensor grid
    left_last: U16  # (h, w) last event of either polarity, left
    right_last: U16  # (h, w) right
    time_noise_ns: int = 0  # standard deviation of the time stamps' errors, as far as known


@dataclass(frozen=True, slots=True)
class FlowBatch:
    """Normal flow at selected events: flow -> optimizer. Positions and flow on the rectified left image."""

    seq: int
    t_ns: int  # end of the batch
    n_selected: int  # events in the EventBatch; the culled ones are missing below
    index: U16  # (m,) position in the EventBatch, increasing
    age: U32  # (m,) ns before t_ns
    x: F32  # (m,) rectified px
    y: F32  # (m,) rectified px
    n: F32  # (m, 2) unit vector along the normal flow (direction of motion of the edge)
    speed: F32  # (m,) normal flow, px/s, > 0
    sigma: F32  # (m,) standard deviation of speed, px/s
    batch_seq: int = -1  # of the DepthBatch at the same events; -1: seq itself
    first: int = 0  # what to add to index for the position there
    t_start_ns: int = -1  # start of the batch, -1: not known
    n_events: int = -1  # left events in the batch before selection, -1: not known


@dataclass(frozen=True, slots=True)
class DepthBatch:
    """Inverse depth at selected events: depth -> optimizer."""

    seq: int
    t_ns: int
    n_selected: int
    index: U16  # (m,) position in the batch, increasing
    disparity: F32  # (m,) px on the rectified images
    inv_depth: F32  # (m,) 1/Z, 1/m, frame C
    sigma: F32  # (m,) standard deviation of inv_depth, 1/m
    refined: U8  # (m,) 1 = plane coincidence, 0 = block matching only
    t_start_ns: int = -1  # start of the batch, -1: not known


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """Checked and ordered IMU samples, and how far the events have been batched: ingest -> optimizer.

    Every batch with ``t_ns <= event_t_ns`` has been sent; ``batch_seq`` is the last of them (-1: none yet) and
    ``batch_t_ns`` its end. The optimizer waits for those and for no others, so its result does not depend on
    the order in which messages arrive.
    """

    seq: int
    t_ns: int  # time of the last sample (here or in an earlier message), 0 before the first
    event_t_ns: int
    batch_seq: int
    batch_t_ns: int
    sample_t_ns: I64  # (n,) camera clock (T_imu-camera offset already applied), increasing; n may be 0
    accel: F64  # (n, 3) m/s^2, frame B
    gyro: F64  # (n, 3) rad/s, frame B


class TrackingState(StrEnum):
    """What the optimizer says of its own estimate."""

    INITIALISING = "initialising"
    TRACKING = "tracking"
    DEGRADED = "degraded"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class Velocity:
    """The product: linear velocity of the origin of B (the IMU), expressed in B."""

    seq: int
    t_ns: int  # sensor time of the estimate
    v_B: F64  # (3,) m/s
    cov: F64  # (3, 3) covariance of v_B, (m/s)^2
    valid: bool
    state: str  # a TrackingState
    reason: str  # why not tracking; "" while tracking
    batch_seq: int  # newest batch that went into it, -1: none
    batch_t_ns: int  # its end; t_ns - batch_t_ns was bridged by the IMU
    age_ms: float = math.nan  # sensor time to publication; see ``velod.runtime.measure.SensorClock``
    up_B: F64 = field(default_factory=lambda: np.full(3, np.nan))  # (3,) unit vector against gravity, frame B
    up_cov: F64 = field(default_factory=lambda: np.full((3, 3), np.nan))  # (3, 3) of up_B, rad^2, rank 2
    frame: str = "imu"  # what B is: "imu", "camera", or the name of a frame from the settings
    degenerate: int = 0  # directions of v_B that the last flows say nothing of ...
    degenerate_B: F64 = field(default_factory=lambda: np.zeros((3, 3)))  # ... unit vectors in the first rows, frame B


@dataclass(frozen=True, slots=True)
class Odometry:
    """Dead reckoning: the velocity integrated once. Frame O: where it began, z up, heading of B zero then."""

    seq: int
    t_ns: int  # sensor time
    origin_t_ns: int  # when it began; it begins anew after the velocity was lost
    p_OB: F64  # (3,) position of B's origin, m, frame O
    q_OB: F64  # (4,) attitude, xyzw
    cov: F64  # (3, 3) covariance of p_OB, m^2
    distance_m: float  # way since the origin
    age_ms: float = math.nan  # sensor time to publication


@dataclass(frozen=True, slots=True)
class Health:
    """State of one process, published at 1 Hz."""

    seq: int
    t_ns: int  # newest sensor time seen, 0: none yet
    stage: str  # "ingest" | "flow" | "depth" | "optimizer" | "supervisor" | a driver's name
    worker: str  # e.g. "flow-0"
    pid: int
    host: str
    version: str
    uptime_s: float
    counters: dict[str, int] = field(default_factory=dict)  # since start: drops by cause, messages, gaps, ...
    rates: dict[str, float] = field(default_factory=dict)  # per second, over the last period
    latency_ms: dict[str, float] = field(default_factory=dict)  # p50/p99 over the last period
    alarms: dict[str, str] = field(default_factory=dict)  # name -> what is wrong, while it is
    role: str = ""  # among the processes of its stage, where that can change: "leads" | "standby"
    gauges: dict[str, float] = field(default_factory=dict)  # values of now, unit in the name: "clock.drift_ppm"


@dataclass(frozen=True, slots=True)
class Done:
    """A worker has finished a batch (whatever came out of it): worker -> dispatcher."""

    seq: int  # of the batch
    t_ns: int  # of the batch
    stage: str
    worker: str


Message = (
    EventPacket
    | ImuPacket
    | EventBatch
    | StereoBatch
    | FlowBatch
    | DepthBatch
    | ImuSamples
    | Velocity
    | Odometry
    | Health
    | Done
)
