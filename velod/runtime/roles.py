"""The three kinds of worker: ingest (which dispatches), flow and depth (which are dispatched to), the optimizer."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import ClassVar

import zenoh

from velod.config import Settings
from velod.runtime.budget import LoadShedder
from velod.runtime.dispatching import BatchDispatch
from velod.runtime.inbox import Item
from velod.runtime.measure import SensorClock
from velod.runtime.shell import WorkerShell
from velod.runtime.stages import Limited, Stage
from velod.types import DepthBatch, Done, EventBatch, FlowBatch, ImuSamples, Message, Odometry, StereoBatch, Velocity
from velod.wire import Envelope
from velod.wire.topics import (
    ALIVE,
    BATCH_DEPTH,
    BATCH_FLOW,
    DEPTH,
    DONE,
    EVENTS,
    FLOW,
    IMU,
    IMU_SENSOR,
    ODOMETRY,
    VELOCITY,
    Topic,
    key,
)

OVERTAKING = 64
"""Results of several workers overtake each other by no more than this."""
_TOKENS, _CAME, _WENT = "tokens", b"came", b"went"


class IngestShell(WorkerShell):
    """Sensor packets in; IMU samples out to the optimizer, batches out to whichever worker is free."""

    inputs: ClassVar[dict[Topic, int]] = {EVENTS: 0, IMU_SENSOR: 0}

    def __init__(
        self, session: zenoh.Session, settings: Settings, stage_name: str, worker: str, stage: Stage
    ) -> None:
        super().__init__(session, settings, stage_name, worker, stage)
        self._dispatch = BatchDispatch(self.outlet, settings.zenoh.lossless)
        # A lossless replay waits for the slowest instead.
        self._load = LoadShedder(0.0 if settings.zenoh.lossless else 1e-3 * settings.ingest.budget_ms)

    def subscribe(self, stack: ExitStack) -> None:
        """The sensor, answers of workers, and their coming and going."""
        super().subscribe(stack)
        # Word of workers overtakes the sensor: however far ingest is behind, an idle worker gets the next batch.
        self.listen(stack, DONE, key(DONE, self.rig), urgent=True)
        self.inbox.add_source(_TOKENS, self.depth, urgent=True)
        callback = zenoh.handlers.Callback(self._token_changed, indirect=False)
        tokens = self.session.liveliness().declare_subscriber(key(ALIVE, self.rig), callback, history=True)
        stack.enter_context(tokens)

    def _token_changed(self, sample: zenoh.Sample) -> None:
        came = sample.kind == zenoh.SampleKind.PUT
        self.inbox.put(_TOKENS, str(sample.key_expr), _CAME if came else _WENT)

    def take_other(self, item: Item) -> bool:
        """Workers that come and go, and event packets that are too old; the others come within a new budget."""
        if item.source == _TOKENS:
            self._dispatch.alive(item.key, item.data == _CAME)
            return True
        if item.source != EVENTS.name:
            return False
        now_s = time.monotonic()
        if not self._load.takes_packet((time.time_ns() - item.t_ns) * 1e-9, now_s):
            return True
        self._load.note_workers(*self._dispatch.load(), now_s)
        if isinstance(self.stage, Limited):
            self.stage.budget = self._load.budget()
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
        for output in outputs:
            if isinstance(output, EventBatch | StereoBatch):
                self._dispatch.send(output, t_origin_ns)
                if isinstance(output, EventBatch):
                    self._load.note_batch()
                self.health.add_latency("stage", time.time_ns() - cause.t_pub_ns)
            elif isinstance(output, ImuSamples):
                self.outlet.publish(IMU, output, t_origin_ns)

    def every_second(self) -> None:
        """Health, and batches that nobody answered for."""
        self._load.end_period(self.stage.counters)
        super().every_second()
        self._dispatch.expire()

    def counters(self) -> dict[str, int]:
        """With those of dispatch and of the load that was shed."""
        return {**super().counters(), **self._dispatch.counters(), **self._load.counters}

    def alarms(self) -> dict[str, str]:
        """With those of dispatch and of the load."""
        return {**super().alarms(), **self._dispatch.alarms(), **self._load.alarms()}


class BatchShell(WorkerShell):
    """A flow or depth worker: one batch in, one result out, and word to the dispatcher that it is done."""

    depth: ClassVar[int] = 16  # of the inbox; a window of batches is sent at once, more are repeats
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


class OptimizerShell(WorkerShell):
    """Flow, depth and IMU in, velocities out, each with the time at which its newest batch was closed."""

    inputs: ClassVar[dict[Topic, int]] = {FLOW: OVERTAKING, DEPTH: OVERTAKING, IMU: 0}
    _REMEMBERED = 256

    def __init__(
        self, session: zenoh.Session, settings: Settings, stage_name: str, worker: str, stage: Stage
    ) -> None:
        super().__init__(session, settings, stage_name, worker, stage)
        self._origin_ns: dict[tuple[int, int], int] = {}  # by seq and end of the batch
        self._newest = (-1, 0)
        self._clock = SensorClock()

    def publish(self, outputs: Sequence[Message], cause: Envelope) -> None:
        """Velocities; the first one that uses a batch tells how long the batch took from end to end."""
        message = cause.message
        if isinstance(message, ImuSamples):
            self._clock.heard(max(message.t_ns, message.event_t_ns), cause.t_origin_ns)
        if isinstance(message, FlowBatch | DepthBatch):
            self._origin_ns[message.seq, message.t_ns] = cause.t_origin_ns
            if len(self._origin_ns) > self._REMEMBERED:
                del self._origin_ns[next(iter(self._origin_ns))]
        for output in outputs:
            if not isinstance(output, Velocity | Odometry):
                continue
            output = replace(output, age_ms=self._clock.age_ms(output.t_ns, time.time_ns()))
            if isinstance(output, Odometry):
                self.outlet.publish(ODOMETRY, output)
                continue
            batch = (output.batch_seq, output.batch_t_ns)
            t_origin_ns = self._origin_ns.get(batch, 0)
            t_pub_ns = self.outlet.publish(VELOCITY, output, t_origin_ns)
            self.health.add_latency("stage", t_pub_ns - cause.t_pub_ns)
            if batch != self._newest and t_origin_ns:
                self.health.add_latency("end_to_end", t_pub_ns - t_origin_ns)
            self._newest = batch


SHELLS: dict[str, type[WorkerShell]] = {
    "ingest": IngestShell,
    "flow": FlowShell,
    "depth": DepthShell,
    "optimizer": OptimizerShell,
}
