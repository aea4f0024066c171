"""The one table of topics. Keys, rates, staleness and quality of service come from here and from nowhere else."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from velod import types


@dataclass(frozen=True, slots=True)
class Qos:
    """How a topic travels. Nothing here blocks: blocking is for lossless replay, and set there."""

    priority: str = "data"  # a zenoh priority: "real_time" | "data_high" | "data" | "background" ...
    depth: int = 64  # newest messages that a subscriber keeps


@dataclass(frozen=True, slots=True)
class Topic:
    """One kind of key, and what is to be expected on it."""

    name: str
    template: str  # the key, with {rig} and further parts to fill in
    message: type[Any] | None  # None: no velod message (liveliness token, queryable)
    rate_hz: float  # nominal messages per second of one publisher; 0: on demand
    stale_after_s: float  # silence after which a publisher is said to be stale; 0: silence means nothing
    qos: Qos = Qos()


_STREAM = Qos(depth=256)

EVENTS = Topic("events", "velod/{rig}/sensor/events/{camera}", types.EventPacket, 200.0, 0.5, _STREAM)
IMU_SENSOR = Topic("imu_sensor", "velod/{rig}/sensor/imu", types.ImuPacket, 200.0, 0.5, _STREAM)
BATCH_FLOW = Topic("batch_flow", "velod/{rig}/batch/flow/{worker}", types.EventBatch, 50.0, 0.0)
BATCH_DEPTH = Topic("batch_depth", "velod/{rig}/batch/depth/{worker}", types.StereoBatch, 50.0, 0.0)
FLOW = Topic("flow", "velod/{rig}/flow", types.FlowBatch, 50.0, 0.5, _STREAM)
DEPTH = Topic("depth", "velod/{rig}/depth", types.DepthBatch, 50.0, 0.5, _STREAM)
IMU = Topic("imu", "velod/{rig}/imu", types.ImuSamples, 250.0, 0.5, _STREAM)
VELOCITY = Topic("velocity", "velod/{rig}/velocity", types.Velocity, 75.0, 0.2, Qos("real_time", 8))
VELOCITY_AGAIN = Topic("velocity_again", "velod/{rig}/velocity/again", types.Velocity, 0.0, 0.0, VELOCITY.qos)
ODOMETRY = Topic("odometry", "velod/{rig}/odometry", types.Odometry, 75.0, 0.0, Qos("data_high", 8))
ODOMETRY_RESET = Topic("odometry_reset", "velod/{rig}/odometry/reset", None, 0.0, 0.0)
DONE = Topic("done", "velod/{rig}/done/{stage}", types.Done, 50.0, 0.0, Qos("data_high", 256))
HEALTH = Topic("health", "velod/{rig}/health/{worker}", types.Health, 1.0, 3.0, Qos("background", 64))
ALIVE = Topic("alive", "velod/{rig}/alive/{stage}/{worker}", None, 0.0, 0.0)
PRIME = Topic("prime", "velod/{rig}/prime", None, 0.0, 0.0)
CALIBRATION = Topic("calibration", "velod/{rig}/calibration", None, 0.0, 0.0)
CONFIG = Topic("config", "velod/{rig}/config", None, 0.0, 0.0)

TOPICS: dict[str, Topic] = {
    t.name: t
    for t in (
        EVENTS,
        IMU_SENSOR,
        BATCH_FLOW,
        BATCH_DEPTH,
        FLOW,
        DEPTH,
        IMU,
        VELOCITY,
        VELOCITY_AGAIN,
        ODOMETRY,
        ODOMETRY_RESET,
        DONE,
        HEALTH,
        ALIVE,
        PRIME,
        CALIBRATION,
        CONFIG,
    )
}

LINKED = "velod/linked"
"""The one key of no rig, and of no topic: asked with whom it is linked, the introducer answers."""

_PART = re.compile(r"\{(\w+)\}")
_FORBIDDEN = frozenset("/*$?# ")
ANY_RIG = "*"
"""In place of a rig's name, for a subscriber: all of them."""


def key(topic: Topic, rig: str, **parts: str) -> str:
    """The key of a topic. A part that is left out becomes ``*``: ``key(HEALTH, "rig0")`` is for a subscriber, and so
    is ``key(VELOCITY, ANY_RIG)``.

    Raises ValueError for a part that the topic does not have, or that cannot be one part of a key.
    """
    names = _PART.findall(topic.template)
    given = {"rig": rig, **parts}
    for name, value in given.items():
        if name not in names:
            raise ValueError(f"topic {topic.name} has no part {name!r}")
        if not value or (_FORBIDDEN & set(value) and (name, value) != ("rig", ANY_RIG)):
            raise ValueError(f"{name} = {value!r}: must be one part of a key, without / * $ ? # or blanks")
    return topic.template.format(**{name: given.get(name, "*") for name in names})


def parts(topic: Topic, found: str) -> dict[str, str]:
    """The parts of a key that was received: ``{"rig": "rig0", "worker": "flow-0"}``; ValueError for an alien key."""
    pattern = _PART.sub(r"(?P<\1>[^/]+)", topic.template)
    match = re.fullmatch(pattern, found)
    if match is None:
        raise ValueError(f"{found!r} is not a key of topic {topic.name}")
    return match.groupdict()
