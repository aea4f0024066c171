"""The topic table is the only place that knows keys."""

from __future__ import annotations

import pytest

from velod.wire import topics
from velod.wire.topics import key, parts


@pytest.mark.parametrize(
    ("topic", "given", "expected"),
    [
        (topics.EVENTS, {"camera": "left"}, "velod/rig0/sensor/events/left"),
        (topics.IMU_SENSOR, {}, "velod/rig0/sensor/imu"),
        (topics.BATCH_FLOW, {"worker": "flow-1"}, "velod/rig0/batch/flow/flow-1"),
        (topics.BATCH_DEPTH, {"worker": "depth-0"}, "velod/rig0/batch/depth/depth-0"),
        (topics.FLOW, {}, "velod/rig0/flow"),
        (topics.DEPTH, {}, "velod/rig0/depth"),
        (topics.IMU, {}, "velod/rig0/imu"),
        (topics.VELOCITY, {}, "velod/rig0/velocity"),
        (topics.VELOCITY_AGAIN, {}, "velod/rig0/velocity/again"),
        (topics.DONE, {"stage": "flow"}, "velod/rig0/done/flow"),
        (topics.HEALTH, {"worker": "flow-1"}, "velod/rig0/health/flow-1"),
        (topics.ALIVE, {"stage": "flow", "worker": "flow-1"}, "velod/rig0/alive/flow/flow-1"),
        (topics.ODOMETRY_RESET, {}, "velod/rig0/odometry/reset"),
        (topics.CALIBRATION, {}, "velod/rig0/calibration"),
        (topics.CONFIG, {}, "velod/rig0/config"),
    ],
)
def test_keys_are_the_documented_ones(topic: topics.Topic, given: dict[str, str], expected: str) -> None:
    assert key(topic, "rig0", **given) == expected
    assert parts(topic, expected) == {"rig": "rig0", **given}


def test_a_part_that_is_left_out_becomes_a_wildcard() -> None:
    assert key(topics.ALIVE, "rig0", stage="flow") == "velod/rig0/alive/flow/*"


@pytest.mark.parametrize("bad", ["", "a/b", "*", "a b", "x#", "$*"])
def test_a_part_that_would_break_the_key_is_refused(bad: str) -> None:
    with pytest.raises(ValueError, match="one part of a key"):
        key(topics.HEALTH, "rig0", worker=bad)


def test_a_part_that_the_topic_does_not_have_is_refused() -> None:
    with pytest.raises(ValueError, match="no part 'worker'"):
        key(topics.VELOCITY, "rig0", worker="flow-0")


def test_an_alien_key_is_refused() -> None:
    with pytest.raises(ValueError, match="not a key of topic health"):
        parts(topics.HEALTH, "velod/rig0/velocity")
