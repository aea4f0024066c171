"""The worker shell over a session of its own: what one bad message or a broken stage does to it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
import zenoh

from velod.cli import watch
from velod.cli.exit import EXIT_FAILED
from velod.cli.place import Way
from velod.client import VelocityClient
from velod.config import Settings
from velod.runtime.outlet import Outlet
from velod.runtime.roles import SENSOR_CLOCK_S, SHELLS
from velod.runtime.shell import WorkerShell
from velod.types import DepthBatch, Done, EventBatch, FlowBatch, ImuPacket, ImuSamples, Message, Velocity
from velod.wire import Envelope, decode, encode
from velod.wire.topics import ALIVE, BATCH_FLOW, DEPTH, DONE, FLOW, HEALTH, IMU, IMU_SENSOR, VELOCITY, Topic, key


class FakeStage:
    """Answers with what a function says."""

    def __init__(self, answer: Callable[[Any], Sequence[Message]]) -> None:
        self.counters = {"seen": 0}
        self.alarms = {"lens": "dirty"}
        self._answer = answer

    def handle(self, message: Any) -> Sequence[Message]:
        self.counters["seen"] += 1
        return self._answer(message)


class Bench:
    """A shell that runs in a thread, and everything that it publishes."""

    def __init__(self, session: zenoh.Session, stage_name: str, stage: FakeStage) -> None:
        self.shell: WorkerShell = SHELLS[stage_name](session, Settings(), stage_name, f"{stage_name}-0", stage)
        self.outlet = Outlet(session, "rig0")
        self.heard: dict[str, list[Envelope]] = {}
        for topic in (FLOW, DONE, VELOCITY, HEALTH):
            self._listen(session, topic)
        self._stop = Event()
        self._thread = Thread(target=self.shell.run, args=(self._stop,))

    def _listen(self, session: zenoh.Session, topic: Topic) -> None:
        heard = self.heard.setdefault(topic.name, [])
        session.declare_subscriber(key(topic, "rig0"), lambda s: heard.append(decode(s.payload.to_bytes())))

    def __enter__(self) -> Bench:
        self._thread.start()
        time.sleep(0.1)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def wait_for(self, topic: Topic, n: int) -> list[Envelope]:
        deadline_s = time.monotonic() + 5.0
        while len(self.heard[topic.name]) < n and time.monotonic() < deadline_s:
            time.sleep(0.01)
        return self.heard[topic.name]


def event_batch(seq: int) -> EventBatch:
    empty = np.zeros(0, np.uint16)
    return EventBatch(
        seq,
        1000 + seq,
        0,
        0,
        empty,
        empty,
        np.zeros(0, np.uint32),
        np.zeros(0, np.uint8),
        np.zeros((0, 25), np.uint32),
    )


def flow_batch(seq: int, t_ns: int) -> FlowBatch:
    f = np.zeros(0, np.float32)
    return FlowBatch(
        seq, t_ns, 0, np.zeros(0, np.uint16), np.zeros(0, np.uint32), f, f, np.zeros((0, 2), np.float32), f, f
    )


def depth_batch(seq: int, t_ns: int) -> DepthBatch:
    f = np.zeros(0, np.float32)
    return DepthBatch(seq, t_ns, 0, np.zeros(0, np.uint16), f, f, f, np.zeros(0, np.uint8))


def velocity(batch_seq: int, batch_t_ns: int) -> Velocity:
    return Velocity(0, 5000, np.zeros(3), np.eye(3), True, "tracking", "", batch_seq, batch_t_ns)


def test_a_worker_answers_with_its_result_and_done_and_passes_the_origin_on(session: zenoh.Session) -> None:
    with Bench(session, "flow", FakeStage(lambda b: [flow_batch(b.seq, b.t_ns)])) as bench:
        bench.outlet.publish(BATCH_FLOW, event_batch(7), t_origin_ns=123, worker="flow-0")
        (done,) = bench.wait_for(DONE, 1)
        (flow,) = bench.wait_for(FLOW, 1)
    assert done.message == Done(7, 1007, "flow", "flow-0")
    assert (flow.message.seq, flow.t_origin_ns) == (7, 123)
    assert flow.t_pub_ns > 123


def test_a_stage_that_raises_is_counted_and_the_batch_is_done_all_the_same(session: zenoh.Session) -> None:
    def answer(batch: EventBatch) -> Sequence[Message]:
        if batch.seq == 0:
            raise ZeroDivisionError("no")
        return [flow_batch(batch.seq, batch.t_ns)]

    with Bench(session, "flow", FakeStage(answer)) as bench:
        for seq in (0, 1):
            bench.outlet.publish(BATCH_FLOW, event_batch(seq), worker="flow-0")
        assert [d.message.seq for d in bench.wait_for(DONE, 2)] == [0, 1]
        assert [f.message.seq for f in bench.wait_for(FLOW, 1)] == [1]
    assert bench.shell.counters()["error.ZeroDivisionError"] == 1


def test_a_result_that_cannot_be_encoded_is_counted_and_the_batch_is_done(session: zenoh.Session) -> None:
    broken = Velocity(0, 0, np.zeros(2), np.eye(3), True, "tracking", "", 0, 0)  # two of three components
    with Bench(session, "flow", FakeStage(lambda b: [broken])) as bench:
        bench.outlet.publish(BATCH_FLOW, event_batch(3), worker="flow-0")
        assert [d.message.seq for d in bench.wait_for(DONE, 1)] == [3]
    assert sum(n for name, n in bench.shell.counters().items() if name.startswith("error.")) == 1


def test_garbage_is_counted_by_reason_and_does_not_reach_the_stage(session: zenoh.Session) -> None:
    stage = FakeStage(lambda b: [])
    with Bench(session, "flow", stage) as bench:
        session.put(key(BATCH_FLOW, "rig0", worker="flow-0"), b"garbage")
        bench.outlet.publish(BATCH_FLOW, event_batch(0), worker="flow-0")
        bench.wait_for(DONE, 1)
    assert stage.counters == {"seen": 1}
    assert sum(n for name, n in bench.shell.counters().items() if name.startswith("wire.")) == 1


def test_a_velocity_carries_the_origin_of_the_batch_it_used(session: zenoh.Session) -> None:
    def answer(message: Message) -> Sequence[Message]:
        return [velocity(1, 1001)] if isinstance(message, ImuSamples) else []

    with Bench(session, "optimizer", FakeStage(answer)) as bench:
        for seq in (0, 1, 2):
            bench.outlet.publish(FLOW, flow_batch(seq, 1000 + seq), t_origin_ns=100 + seq)
            bench.outlet.publish(DEPTH, depth_batch(seq, 1000 + seq), t_origin_ns=100 + seq)
        time.sleep(0.2)
        nothing = np.zeros((0, 3))
        bench.outlet.publish(IMU, ImuSamples(0, 0, 0, 2, 1002, np.zeros(0, np.int64), nothing, nothing))
        (out,) = bench.wait_for(VELOCITY, 1)
    assert out.t_origin_ns == 101


def test_a_velocity_is_as_old_as_its_sample_however_long_that_waited_to_be_handled(session: zenoh.Session) -> None:
    """A process that has just started has work waiting, and must not take that for the way from the sensor."""

    def answer(samples: ImuSamples) -> Sequence[Message]:
        time.sleep(0.3)
        return [replace(velocity(0, 0), t_ns=samples.t_ns)]

    nothing = np.zeros((0, 3))
    with Bench(session, "optimizer", FakeStage(answer)) as bench:
        for seq in range(2):
            at = ImuSamples(seq, time.time_ns(), 0, -1, 0, np.zeros(0, np.int64), nothing, nothing)
            bench.outlet.publish(IMU, at)
        first, second = bench.wait_for(VELOCITY, 2)
    assert first.message.age_ms >= 290.0
    assert second.message.age_ms >= 590.0


def test_what_waited_in_ingest_counts_as_age_because_the_sensor_s_own_packets_did_not(session: zenoh.Session) -> None:
    """All that a new ingest sends is late at first; one packet with a time that cannot be is believed no more."""

    class Moving(FakeStage):
        time_offset_s = 0.01

    nothing = np.zeros((0, 3))
    with Bench(session, "optimizer", Moving(lambda m: [replace(velocity(0, 0), t_ns=m.t_ns)])) as bench:
        for seq, glitch_ns in enumerate((0, 0, 5_000_000_000, 0)):
            t_ns = time.time_ns() + 10_000_000 + glitch_ns
            at = np.array([t_ns])
            bench.outlet.publish(IMU_SENSOR, ImuPacket(seq, t_ns, at, np.zeros((1, 3)), np.zeros((1, 3))))
            time.sleep(1.2 * SENSOR_CLOCK_S)
        late_ns = time.time_ns() - 170_000_000
        late = ImuSamples(0, late_ns, 0, -1, 0, np.zeros(0, np.int64), nothing, nothing)
        bench.outlet.publish(IMU, late)
        out, *_ = bench.wait_for(VELOCITY, 1)  # and those of the packets that the bridge had kept
    assert 160.0 < out.message.age_ms < 1000.0


@pytest.mark.parametrize("reached_the_consumer", [4, 5], ids=["all but the last", "all"])
def test_a_leader_s_last_velocity_reaches_a_client_though_it_died_before_all_had_it(
    session: zenoh.Session, port: int, reached_the_consumer: int
) -> None:
    """Who publishes to several dies between two of them; and nothing is there twice, on the product's own key."""

    def tick(k: int) -> Velocity:
        return replace(velocity(0, 0), seq=k, t_ns=1_000_000_000 + 13_500_000 * k)

    nothing = np.zeros((0, 3))
    other = "optimizer-1"
    token = key(ALIVE, "rig0", stage="optimizer", worker=other)
    with (
        Bench(session, "optimizer", FakeStage(lambda m: [replace(velocity(0, 0), t_ns=m.t_ns)])) as bench,
        VelocityClient("rig0", f"tcp/127.0.0.1:{port}", math.inf) as client,
    ):
        while client.receive(0.05) is None:
            bench.outlet.publish(VELOCITY, tick(0))
        bench.shell.inbox.put("tokens", token, b"came")
        for k in range(1, 6):
            if k < 5:
                bench.shell.inbox.put(VELOCITY.name, other, encode(tick(k), time.time_ns()))
            if k < reached_the_consumer:
                bench.outlet.publish(VELOCITY, tick(k))
            samples = ImuSamples(k, tick(k).t_ns, 0, -1, 0, np.zeros(0, np.int64), nothing, nothing)
            bench.outlet.publish(IMU, samples)
        bench.shell.inbox.put("tokens", token, b"went")
        handed_out = [client.receive(5.0) for _ in range(5)]
        plain = [0]
        while plain[-1] != 5:
            plain = [e.message.seq for e in bench.heard[VELOCITY.name]]
    assert [v.seq for v in handed_out if v is not None] == [1, 2, 3, 4, 5]
    assert [v.t_ns for v in handed_out if v is not None] == [tick(k).t_ns for k in range(1, 6)]
    assert [seq for seq in plain if seq] == [*range(1, reached_the_consumer), 5]


def test_health_tells_counters_gaps_rates_and_alarms(session: zenoh.Session) -> None:
    with Bench(session, "optimizer", FakeStage(lambda m: [])) as bench:
        for seq in (0, 1, 5):
            nothing = np.zeros((0, 3))
            bench.outlet.publish(IMU, ImuSamples(seq, 77, 0, -1, 0, np.zeros(0, np.int64), nothing, nothing))
        first, *_ = bench.wait_for(HEALTH, 1)
    health = first.message
    assert (health.stage, health.worker, health.t_ns) == ("optimizer", "optimizer-0", 77)
    assert health.counters["seen"] == health.counters["in.imu"] == 3
    assert health.counters["gap.imu"] == 3
    assert health.rates["in.imu"] == pytest.approx(3.0, rel=0.2)
    assert health.alarms["lens"] == "dirty"


def test_silence_of_one_publisher_is_an_alarm(session: zenoh.Session) -> None:
    with Bench(session, "optimizer", FakeStage(lambda m: [])) as bench:
        bench.outlet.publish(FLOW, flow_batch(0, 1))
        bench.outlet.publish(DEPTH, depth_batch(0, 1))
        time.sleep(0.7)
        bench.outlet.publish(DEPTH, depth_batch(1, 2))
        time.sleep(0.1)
        assert [name for name in bench.shell.alarms() if name.startswith("stale")] == ["stale.velod/rig0/flow"]


def test_a_query_resets_the_odometry_of_every_optimizer_that_hears_it(
    session: zenoh.Session, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Reckoner(FakeStage):
        resets = 0

        def reset_odometry(self) -> None:
            self.resets += 1

    class Young:
        """A session that was just opened: it does not know yet who answers."""

        asked = 0

        def get(self, *args: Any, **kwargs: Any) -> Any:
            self.asked += 1
            return session.get(*args, **kwargs) if self.asked > 2 else []

    stage = Reckoner(lambda message: [])
    monkeypatch.setattr(watch, "open_session", lambda settings: nullcontext(Young()))
    monkeypatch.setattr(watch, "_DISCOVERY_S", 0.5)
    with Bench(session, "optimizer", stage):
        assert watch.reset_odometry(None, Way()) == 0
        deadline_s = time.monotonic() + 5.0
        while not stage.resets and time.monotonic() < deadline_s:
            time.sleep(0.01)
    assert stage.resets == 1
    assert "reset by optimizer-0" in capsys.readouterr().out
    assert watch.reset_odometry(None, Way()) == EXIT_FAILED
