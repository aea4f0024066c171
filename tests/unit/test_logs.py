"""What ``velod record`` writes: sensor streams as a sequence file, topics as MCAP."""

from __future__ import annotations

import json
import math
import time
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import ClassVar, Self

import numpy as np
import pytest
from mcap.reader import make_reader

from tests import slanted_scene
from velod.cli import record
from velod.cli.place import Place
from velod.client import Received
from velod.config import ZenohSettings
from velod.io import RecordingError, open_recording
from velod.io.live import SensorLog
from velod.io.mcap_log import McapLog
from velod.io.packets import Chunking
from velod.io.sequence import RecordingWriter
from velod.types import DepthBatch, EventPacket, Health, ImuPacket, Velocity
from velod.wire import Envelope, decode, encode
from velod.wire.topics import VELOCITY

T = 1_000_000_000


def velocity() -> Velocity:
    return Velocity(7, T, np.array([1.0, 2.0, math.nan]), np.eye(3), False, "lost", "no flow", 4, T)


def health() -> Health:
    return Health(1, T, "flow", "flow-0", 12, "host", "0.1", 3.5, {"in": 4}, {"in": 50.0}, {}, {"x": "y"}, "", {})


def depth() -> DepthBatch:
    one = np.ones(2, np.float32)
    return DepthBatch(3, T, 5, np.array([1, 2], np.uint16), one, one, one, np.ones(2, np.uint8))


def test_what_a_driver_sent_is_in_the_sequence_file(tmp_path: Path) -> None:
    original = open_recording(slanted_scene.write(tmp_path / "original.h5", 0.3))
    with SensorLog(tmp_path / "log.h5", original.calibration) as log:
        for packet in original.packets(Chunking.parse("random:3")):
            log.add(packet)
        log.finish()
    again = open_recording(tmp_path / "log.h5")
    assert log.counters == {}
    assert again.calibration.to_tree() == original.calibration.to_tree()
    assert np.array_equal(again.imu.t_ns, original.imu.t_ns) and np.array_equal(again.imu.gyro, original.imu.gyro)
    for side in ("left", "right"):
        ours, theirs = (list(getattr(r, side).blocks()) for r in (again, original))
        for column in ("t_ns", "x", "y", "p"):
            a, b = (np.concatenate([getattr(block, column) for block in blocks]) for blocks in (ours, theirs))
            assert np.array_equal(a, b), (side, column)


def events(camera: str, *t_ns: int) -> EventPacket:
    pixel, on = np.ones(len(t_ns), np.uint16), np.ones(len(t_ns), np.uint8)
    return EventPacket(0, max(t_ns), camera, pixel, pixel, np.array(t_ns, np.int64), on)


def samples(*t_ns: int) -> ImuPacket:
    return ImuPacket(0, max(t_ns), np.array(t_ns, np.int64), np.ones((len(t_ns), 3)), np.ones((len(t_ns), 3)))


def test_what_goes_back_in_time_is_left_out_and_counted(tmp_path: Path) -> None:
    with SensorLog(tmp_path / "log.h5", slanted_scene.RIG) as log:
        for message in (
            *(events("left", T, T + 5000), events("left", T - 5000), events("left", T + 9000, T + 7000)),
            *(events("right", T), samples(T, T + 5000), samples(T + 2000, T + 9000), samples(T + 9500)),
        ):
            log.add(message)
        log.finish()
    assert log.counters == {"back_in_time.left": 3, "back_in_time.imu": 2}
    recording = open_recording(tmp_path / "log.h5")
    assert (recording.left.n_events, recording.right.n_events) == (2, 1)
    assert recording.imu.t_ns.tolist() == [T, T + 5000, T + 9000]


def test_times_become_whole_microseconds(tmp_path: Path) -> None:
    with SensorLog(tmp_path / "log.h5", slanted_scene.RIG) as log:
        for message in (events("left", T + 1), events("right", T + 999), samples(T + 1, T + 1500)):
            log.add(message)
        log.finish()
    recording = open_recording(tmp_path / "log.h5")
    assert (recording.left.first_t_ns, recording.right.first_t_ns) == (T, T)
    assert recording.imu.t_ns.tolist() == [T, T + 1000]


def test_without_one_of_the_streams_there_is_no_file_and_the_reason_is_said(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no right events, no IMU samples came"):  # noqa: SIM117
        with SensorLog(tmp_path / "log.h5", slanted_scene.RIG) as log:
            log.add(events("left", T))
            log.finish()
    assert list(tmp_path.iterdir()) == []


def test_cameras_that_differ_do_not_fit_into_the_file(tmp_path: Path) -> None:
    rig = replace(slanted_scene.RIG, right=replace(slanted_scene.CAMERA, fx=201.0, fy=201.0))
    with pytest.raises(RecordingError, match="two equal, aligned cameras only"):
        RecordingWriter(tmp_path / "log.h5", rig)
    assert list(tmp_path.iterdir()) == []


def test_small_messages_are_json_that_keeps_its_schema_and_others_the_bytes_of_the_wire(tmp_path: Path) -> None:
    sent = {"velod/r/velocity": velocity(), "velod/r/health/flow-0": health(), "velod/r/depth": depth()}
    with McapLog(tmp_path / "log.mcap", {"rig": "r"}) as log:
        for i, (key, message) in enumerate(sent.items()):
            log.add(key, Envelope(message, 5 + i, 2), 10 + i)
    with (tmp_path / "log.mcap").open("rb") as file:
        reader = make_reader(file)
        found = {channel.topic: (s, channel, message) for s, channel, message in reader.iter_messages()}
        assert [m.metadata for m in reader.iter_metadata()] == [{"rig": "r"}]
    assert {topic: channel.message_encoding for topic, (_, channel, _) in found.items()} == {
        "velod/r/velocity": "json",
        "velod/r/health/flow-0": "json",
        "velod/r/depth": "msgpack",
    }
    s, _, message = found["velod/r/velocity"]
    stored = json.loads(message.data)
    assert stored["v_B"] == [1.0, 2.0, None] and stored["cov"][1] == [0.0, 1.0, 0.0] and stored["reason"] == "no flow"
    assert (message.publish_time, message.log_time, message.sequence) == (5, 10, 7)
    properties = json.loads(s.data)["properties"]
    assert set(properties) == set(stored) and s.name == "velod.Velocity"
    assert properties["cov"] == {"type": "array", "items": {"type": "array", "items": {"type": "number"}}}
    assert json.loads(found["velod/r/health/flow-0"][2].data)["counters"] == {"in": 4}
    assert found["velod/r/depth"][2].data == encode(depth(), 7, 2)
    assert decode(found["velod/r/depth"][2].data).message.seq == 3


class Queue:
    """In place of a listener: messages that wait already, and one that comes after the end."""

    counters: ClassVar[dict[str, int]] = {}

    def __init__(self, waiting: int) -> None:
        now_ns = time.time_ns()
        late_ns = now_ns + 3_600_000_000_000
        self._items = [
            Received(VELOCITY, "velod/r/velocity", Envelope(velocity(), 1, 0), t_ns, 100)
            for t_ns in (*[now_ns] * waiting, late_ns)
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def receive(self, timeout_s: float) -> Received | None:
        return self._items.pop(0) if self._items else None


def test_what_waits_in_the_queue_when_recording_ends_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record, "Listener", lambda *_: Queue(waiting=5))
    stop = Event()
    stop.set()
    session = record.Session(Place("r", ZenohSettings()), (VELOCITY,), None, stop)
    taken: list[Received] = []
    session.run(tmp_path / "run.mcap", taken.append)
    assert len(taken) == session.n == 5
