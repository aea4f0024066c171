"""The three kinds of worker: ingest (which dispatches), flow and depth (which are dispatched to), the optimizer."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import ClassVar

import zenoh

from velod.config import Settings
from velod.runtime.budget import LoadShedder
from velod.runtime.callbacks import direct
from velod.runtime.dispatching import BatchDispatch
from velod.runtime.imu_bridge import ImuBridge
from velod.runtime.inbox import Item
from velod.runtime.measure import SensorClock
from velod.runtime.sensor_clock import SensorClockFit
from velod.runtime.shell import WorkerShell
from velod.runtime.stages import Inertial, Limited, Reckoning, Stage
from velod.runtime.succession import Succession, Turn
from velod.types import (
    DepthBatch,
    Done,
    EventBatch,
    FlowBatch,
    ImuPacket,
    ImuSamples,
    Message,
    Odometry,
    StereoBatch,
    Velocity,
)
from velod.wire import Envelope, decode
from velod.wire.topics import (
    BATCH_DEPTH,
    BATCH_FLOW,
    DEPTH,
    DONE,
    EVENTS,
    FLOW,
    IMU,
    IMU_SENSOR,
    ODOMETRY,
    ODOMETRY_RESET,
    VELOCITY,
    VELOCITY_AGAIN,
    Topic,
    key,
)

OVERTAKING = 64
"""Results of several workers overtake each other by no more than this."""
AGAIN = 4
"""So many of another optimizer's last velocities are sent once more by the one that takes over: as many as may be
made at once, while it is late."""
SENSOR_CLOCK_S = 0.05
"""How often the optimizer looks at what time the sensor's own packets come."""


class IngestShell(WorkerShell):
    """Sensor packets in; IMU samples out to the optimizer, batches out to whichever worker is free."""

    inputs: ClassVar[dict[Topic, int]] = {EVENTS: 0, IMU_SENSOR: 0}
    sends_large: ClassVar[bool] = True
    in_place: ClassVar[bool] = True

    def __init__(
        self, session: zenoh.Session, settings: Settings, stage_name: str, worker: str, stage: Stage
    ) -> None:
        super().__init__(session, settings, stage_name, worker, stage)
        self._limited = stage if isinstance(stage, Limited) else None
        self._sensor_clock = SensorClockFit()
        self._dispatch = BatchDispatch(self.outlet, settings.zenoh.lossless)
        # A lossless replay waits for the slowest instead.
        s, self._by_event = settings.ingest, settings.ingest.mode == "event"
        targets_s = (1e-3 * s.budget_ms, 1e-3 * s.event_budget_ms if self._by_event else 0.0)
        self._load = LoadShedder(*(0.0, 0.0) if settings.zenoh.lossless else targets_s)

    def subscribe(self, stack: ExitStack) -> None:
        """The sensor, answers of workers, and their coming and going."""
        super().subscribe(stack)
        # Word of workers overtakes the sensor: however far ingest is behind, an idle worker gets the next batch.
        self.listen(stack, DONE, key(DONE, self.rig), urgent=True)
        self.listen_to_tokens(stack)

    def token_changed(self, token: dict[str, str], *, is_there: bool) -> None:
        """A worker came or went."""
        self._dispatch.alive(token, is_there=is_there)

    def take_other(self, item: Item) -> bool:
        """Event packets that are too old; the others come within a new budget."""
        if item.source != EVENTS.name:
            return False
        now_s = time.monotonic()
        if not self._load.takes_packet((time.time_ns() - item.t_ns) * 1e-9, now_s):
            return True
        self._load.note_unanswered(self._dispatch.unanswered_s(), now_s)
        if self._by_event:
            self._load.note_slices(*self._dispatch.load("flow"), now_s)
            self._load.note_workers(*self._dispatch.load("depth"), now_s)
        else:
            self._load.note_workers(*self._dispatch.load("flow", "depth"), now_s)
        if self._limited is not None:
            self._limited.budget = self._load.budget()
        return False

    def consumers(self) -> list[tuple[Topic, dict[str, str]]]:
        """The optimizer."""
        return [(IMU, {})]

    def received(self, source: str, envelope: Envelope) -> None:
        """Done messages."""
        if isinstance(envelope.message, Done):
            self._dispatch.done(envelope.message)

    def publish(self, outputs: Sequence[Message], cause: Envelope) -> None:
        """Batches originate here and now: their results carry this time to the velocity."""
        t_origin_ns = time.time_ns()
        self._sensor_clock.heard(cause.message.t_ns, t_origin_ns)
        for output in outputs:
            if isinstance(output, EventBatch | StereoBatch):
                self._dispatch.send(output, t_origin_ns)
                if isinstance(output, StereoBatch):
                    self._load.note_batch()
                self.health.add_latency("stage", time.time_ns() - cause.t_pub_ns)
            elif isinstance(output, ImuSamples):
                self.outlet.publish(IMU, output, t_origin_ns)

    def every_second(self) -> None:
        """Health, and what was shed."""
        self._load.end_period(self.stage.counters)
        super().every_second()

    def every_round(self) -> None:
        """Batches that nobody answered for."""
        self._dispatch.expire()

    def counters(self) -> dict[str, int]:
        """With those of dispatch and of the load that was shed."""
        return {**super().counters(), **self._dispatch.counters(), **self._load.counters}

    def alarms(self) -> dict[str, str]:
        """With those of dispatch and of the load."""
        return {**super().alarms(), **self._dispatch.alarms(), **self._load.alarms()}

    def gauges(self) -> dict[str, float]:
        """With what was taken on of the load, and the sensor's clock."""
        return {**super().gauges(), **self._load.gauges(), **self._sensor_clock.gauges()}


class BatchShell(WorkerShell):
    """A flow or depth worker: one batch in, one result out, and word to the dispatcher that it is done."""

    depth: ClassVar[int] = 16  # of the inbox; a window of batches is sent at once, more are repeats
    in_place: ClassVar[bool] = True
    output: ClassVar[Topic]

    def subscribe(self, stack: ExitStack) -> None:
        """This worker's own key."""
        for topic in self.inputs:
            self.listen(stack, topic, key(topic, self.rig, worker=self.worker))

    def consumers(self) -> list[tuple[Topic, dict[str, str]]]:
        """The optimizer and the dispatcher."""
        return [(self.output, {}), (DONE, {"stage": self.stage_name})]

    def publish(self, outputs: Sequence[Message], cause: Envelope) -> None:
        """The result, and Done even where there is none: the dispatcher must not wait for ever."""
        try:
            for output in outputs:
                t_pub_ns = self.outlet.publish(self.output, output, cause.t_origin_ns)
                self.health.add_latency("stage", t_pub_ns - cause.t_pub_ns)
        finally:
            done = Done(cause.message.seq, cause.message.t_ns, self.stage_name, self.worker)
            self.outlet.publish(DONE, done, cause.t_origin_ns, stage=self.stage_name)


class FlowShell(BatchShell):
    """EventBatch in, FlowBatch out."""

    inputs: ClassVar[dict[Topic, int]] = {BATCH_FLOW: -1}
    output: ClassVar[Topic] = FLOW


class DepthShell(BatchShell):
    """StereoBatch in, DepthBatch out."""

    inputs: ClassVar[dict[Topic, int]] = {BATCH_DEPTH: -1}
    output: ClassVar[Topic] = DEPTH


@dataclass(frozen=True, slots=True)
class _Output:
    """What one tick of sensor time led to, and when its inputs came about (host clock, ns)."""

    velocity: Velocity
    odometry: Odometry | None
    cause_t_pub_ns: int


class OptimizerShell(WorkerShell):
    """Flow, depth and IMU in, velocities out, each with the time at which its newest batch was closed.

    Where there are several optimizers, one of them publishes, and the others stand by (``succession``).
    """

    inputs: ClassVar[dict[Topic, int]] = {FLOW: OVERTAKING, DEPTH: OVERTAKING, IMU: 0}
    takes_large: ClassVar[bool] = False
    poll_s: ClassVar[float] = 0.01
    _REMEMBERED = 256
    _PEERS: ClassVar[dict[str, type]] = {VELOCITY.name: Velocity, ODOMETRY.name: Odometry}

    def __init__(
        self, session: zenoh.Session, settings: Settings, stage_name: str, worker: str, stage: Stage
    ) -> None:
        super().__init__(session, settings, stage_name, worker, stage)
        self._origin_ns: dict[tuple[int, int], int] = {}  # by seq and end of the batch
        self._newest = (-1, 0)
        self._clock = SensorClock()
        self._sensor_heard: tuple[int, int] | None = None  # sensor time of one of its packets, and its arrival
        self._succession: Succession[_Output] = Succession(worker)
        self._heard_last: deque[Velocity] = deque(maxlen=AGAIN)  # of the others
        self._odometry_seq = 0
        self._bridge: ImuBridge | None = None
        # A lossless replay waits for ingest instead.
        if isinstance(stage, Inertial) and not settings.zenoh.lossless:
            self._bridge = ImuBridge(settings.ingest, stage.time_offset_s)

    def subscribe(self, stack: ExitStack) -> None:
        """The stage's inputs; what other optimizers publish, and their coming and going, before anything else."""
        self.listen_to_tokens(stack, stage=self.stage_name)
        for topic in (VELOCITY, ODOMETRY):
            self._listen_to_peers(stack, topic)
        self._answer_resets(stack)
        if self._bridge is not None:
            self.listen(stack, IMU_SENSOR, key(IMU_SENSOR, self.rig))
        super().subscribe(stack)

    def _answer_resets(self, stack: ExitStack) -> None:
        """Every optimizer hears of a reset, whether it leads or stands by: they go on reckoning alike."""
        self.inbox.add_source(ODOMETRY_RESET.name, self.depth, urgent=True)
        at = key(ODOMETRY_RESET, self.rig)

        def asked(query: zenoh.Query) -> None:
            with query:
                self.inbox.put(ODOMETRY_RESET.name, at, b"")
                query.reply(at, json.dumps({"reset_by": self.worker}))

        stack.enter_context(self.session.declare_queryable(at, asked))

    def _listen_to_peers(self, stack: ExitStack, topic: Topic) -> None:
        self.inbox.add_source(topic.name, self.depth, urgent=True)

        def arrived(sample: zenoh.Sample) -> None:
            author = "" if sample.attachment is None else sample.attachment.to_string()
            self.inbox.put(topic.name, author, sample.payload.to_bytes())

        callback = direct(arrived)
        at = key(topic, self.rig)
        stack.enter_context(self.session.declare_subscriber(at, callback, allowed_origin=zenoh.Locality.REMOTE))

    def token_changed(self, token: dict[str, str], *, is_there: bool) -> None:
        """Another optimizer came or went."""
        if is_there:
            self._succession.joined(token["worker"])
        else:
            self._publish_turns(self._succession.left(token["worker"], time.monotonic()))

    def take_other(self, item: Item) -> bool:
        """What another optimizer has published, resets of the odometry, and the sensor's own IMU packets."""
        if self._bridge is not None and item.source == IMU_SENSOR.name:
            self._bridge.keep(item.data)
            self._hear_sensor(item)
            return True
        if item.source == ODOMETRY_RESET.name:
            if isinstance(self.stage, Reckoning):
                self.stage.reset_odometry()
            return True
        if item.source not in self._PEERS:
            return False
        message = decode(item.data, self._PEERS[item.source]).message
        if not item.key.startswith(f"{self.stage_name}-"):
            self.count("velocity.alien", f"a {item.source} that no optimizer of this rig has sent ({item.key!r})")
        elif isinstance(message, Odometry):
            self._odometry_seq = message.seq + 1
        elif isinstance(message, Velocity):
            self._heard_last.append(message)
            self._succession.heard(item.key, message.t_ns, message.seq, time.monotonic())
        return True

    def _hear_sensor(self, item: Item) -> None:
        """The sensor's own packets do not wait for ingest, which is late for a while after a start."""
        before = self._sensor_heard
        if before is not None and 0 <= item.t_ns - before[1] < SENSOR_CLOCK_S * 1e9:
            return
        packet = decode(item.data, ImuPacket).message
        assert isinstance(self.stage, Inertial)
        t_ns = packet.t_ns - round(self.stage.time_offset_s * 1e9)
        self._sensor_heard = (t_ns, item.t_ns)
        if before is not None:
            # Nobody has checked its times yet: two have to agree before a delay is taken for the least one.
            self._clock.heard(min(t_ns, before[0] + item.t_ns - before[1]), item.t_ns)

    def handle(self, message: Message) -> Sequence[Message]:
        """IMU samples by way of the bridge, which knows what the stage has had already."""
        if self._bridge is None or not isinstance(message, ImuSamples):
            return super().handle(message)
        return [
            output
            for samples in self._bridge.from_ingest(message, time.monotonic())
            for output in super(OptimizerShell, self).handle(samples)
        ]

    def publish(self, outputs: Sequence[Message], cause: Envelope) -> None:
        """Hand the outputs over for publication, here or by another optimizer."""
        message = cause.message
        if isinstance(message, ImuSamples):
            # By this host's clock, like the age below: ingest may run on another one.
            self._clock.heard(max(message.t_ns, message.event_t_ns), self.arrived_ns)
        if isinstance(message, FlowBatch | DepthBatch):
            self._origin_ns[message.seq, message.t_ns] = cause.t_origin_ns
            if len(self._origin_ns) > self._REMEMBERED:
                del self._origin_ns[next(iter(self._origin_ns))]
        odometry = {o.t_ns: o for o in outputs if isinstance(o, Odometry)}
        for output in outputs:
            if isinstance(output, Velocity):
                made = _Output(output, odometry.get(output.t_ns), cause.t_pub_ns)
                self._publish_turns(self._succession.offer(output.t_ns, made, time.monotonic()))

    def every_round(self) -> None:
        """Go on without ingest, and take over from another optimizer, where it is time to."""
        for samples in [] if self._bridge is None else self._bridge.due(time.monotonic()):
            at, cause = key(IMU_SENSOR, self.rig), Envelope(samples, time.time_ns(), 0)
            outputs = self.survived(at, cause, self.stage.handle, samples) or ()
            self.survived(at, cause, self.publish, outputs, cause)
        self._publish_turns(self._succession.look(time.monotonic()))

    def _publish_turns(self, turns: Sequence[Turn[_Output]]) -> None:
        for turn in turns:
            if turn.follows:
                self._publish_again()
            age_ms = self._clock.age_ms(turn.output.velocity.t_ns, time.time_ns())
            self._publish_velocity(replace(turn.output.velocity, seq=turn.seq, age_ms=age_ms), turn.output)
            if turn.output.odometry is not None:
                seq, self._odometry_seq = self._odometry_seq, self._odometry_seq + 1
                self.outlet.publish(ODOMETRY, replace(turn.output.odometry, seq=seq, age_ms=age_ms))

    def _publish_again(self) -> None:
        """What another optimizer published last, once more, on a key beside.

        It died or was stopped, and what has come here need not have come to every consumer. Who takes both keys
        misses nothing; and on the first nothing comes twice.
        """
        for velocity in self._heard_last:
            age_ms = self._clock.age_ms(velocity.t_ns, time.time_ns())
            self.outlet.publish(VELOCITY_AGAIN, replace(velocity, age_ms=age_ms))
        self._heard_last.clear()

    def _publish_velocity(self, velocity: Velocity, made: _Output) -> None:
        """The first velocity that uses a batch tells how long the batch took from end to end."""
        batch = (velocity.batch_seq, velocity.batch_t_ns)
        t_origin_ns = self._origin_ns.get(batch, 0)
        t_pub_ns = self.outlet.publish(VELOCITY, velocity, t_origin_ns)
        self.health.add_latency("stage", t_pub_ns - made.cause_t_pub_ns)
        if batch != self._newest and t_origin_ns:
            self.health.add_latency("end_to_end", t_pub_ns - t_origin_ns)
        self._newest = batch

    def role(self) -> str:
        """Leads or standby."""
        return self._succession.role

    def counters(self) -> dict[str, int]:
        """With those of the succession and of the bridge."""
        bridged = {} if self._bridge is None else self._bridge.counters
        return {**super().counters(), **self._succession.counters, **bridged}


SHELLS: dict[str, type[WorkerShell]] = {
    "ingest": IngestShell,
    "flow": FlowShell,
    "depth": DepthShell,
    "optimizer": OptimizerShell,
}
