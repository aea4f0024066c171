"""The worker shell: subscribes, decodes, calls a stage, publishes what comes out, and reports its health.

One thread, the main one, handles messages; the network's threads only fill the inbox. Whatever is wrong with a
message is counted by name and logged once per kind; it never ends the worker.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from threading import Event
from typing import Any, ClassVar, TypeVar

import zenoh

from velod.config import Settings
from velod.runtime import prime
from velod.runtime.callbacks import direct
from velod.runtime.health import HealthReporter
from velod.runtime.inbox import Inbox, Item
from velod.runtime.measure import GapCounter
from velod.runtime.outlet import Outlet
from velod.runtime.pools import PoolKeeper
from velod.runtime.stages import Stage, Tidying, alarms_of, gauges_of
from velod.types import Message
from velod.wire import Envelope, WireError, decode
from velod.wire.topics import ALIVE, HEALTH, Topic, key, parts

log = logging.getLogger("velod")

T = TypeVar("T")

POLL_S = 0.1
"""How long the main thread sleeps at the most before it looks at signals and at the clock."""
FIFO_DEPTH = 4096
FIFO_BYTES = 64 << 20
"""Ingest and the optimizer must lose nothing inside: seconds of most drivers' packets, 0.3 s of 20 Mev/s."""
BEHIND = 100
"""So many waiting messages mean that the worker cannot keep up."""
CONSUMER_WAIT_S = 2.0
_TOKENS, _CAME, _WENT = "tokens", b"came", b"went"


class WorkerShell:
    """One stage as a process: ``run`` until ``stop`` is set. The three kinds of stages differ in ``roles``."""

    inputs: ClassVar[dict[Topic, int]] = {}
    """What the stage takes, and how far messages on one key may overtake each other; -1: do not look for gaps."""
    depth: ClassVar[int] = FIFO_DEPTH
    poll_s: ClassVar[float] = POLL_S
    sends_large: ClassVar[bool] = False
    """Whether what it publishes goes through shared memory."""
    takes_large: ClassVar[bool] = True
    """Whether what it takes does: then it holds the memory of those who send."""
    in_place: ClassVar[bool] = False
    """Whether the stage takes columns that lie in the message, read-only and at any address."""

    def __init__(
        self, session: zenoh.Session, settings: Settings, stage_name: str, worker: str, stage: Stage
    ) -> None:
        self.session, self.rig = session, settings.rig.name
        self.stage_name, self.worker, self.stage = stage_name, worker, stage
        self.inbox = Inbox()
        self.outlet = Outlet(session, self.rig, settings.zenoh.lossless, author=worker)
        self.health = HealthReporter(stage_name, worker)
        self._inbox_bytes = None if settings.zenoh.lossless else FIFO_BYTES
        self._topics = {t.name: t for t in self.inputs}
        self._counters: dict[str, int] = {}
        self._gaps: dict[str, tuple[str, GapCounter]] = {}  # by key: topic and counter
        self._heard: dict[str, tuple[Topic, float]] = {}  # by key: when the last message came
        self._logged: set[str] = set()
        self._pools = PoolKeeper(takes_large=self.takes_large)
        self._tidying = stage if isinstance(stage, Tidying) else None
        self._t_ns = 0
        self.arrived_ns = 0  # host clock, when what is being handled came in; it may have waited since

    def run(self, stop: Event) -> None:
        """Handle messages until ``stop`` is set; then leave nothing declared."""
        with ExitStack() as stack:
            stack.enter_context(self.outlet)
            if self.takes_large:
                stack.enter_context(prime.listen(self.session, self.rig))
            self.subscribe(stack)
            self._wait_for_consumers(stop)
            if self.sends_large:
                stack.enter_context(prime.prime(self.session, self.rig))
            token = key(ALIVE, self.rig, stage=self.stage_name, worker=self.worker)
            stack.enter_context(self.session.liveliness().declare_token(token))
            log.info("up")
            while not stop.is_set():
                item = self.inbox.get(min(self.poll_s, self.health.due_in_s()))
                if item is not None:
                    self._take(item)
                self.every_round()
                if self.health.due_in_s() == 0.0:
                    self.every_second()
            self.every_second()  # the last word: counters up to the end

    # What a role adds -----------------------------------------------------------------------------------------

    def subscribe(self, stack: ExitStack) -> None:
        """Declare the subscribers of the stage's inputs."""
        for topic in self.inputs:
            self.listen(stack, topic, key(topic, self.rig))

    def consumers(self) -> list[tuple[Topic, dict[str, str]]]:
        """Whom the process needs to be listening before it is of any use."""
        return []

    def received(self, source: str, envelope: Envelope) -> None:
        """A message that is not for the stage."""
        raise NotImplementedError(source)

    def handle(self, message: Message) -> Sequence[Message]:
        """Hand a message to the stage."""
        return self.stage.handle(message)

    def publish(self, outputs: Sequence[Message], cause: Envelope) -> None:
        """Publish what the stage made of ``cause``."""
        raise NotImplementedError

    def counters(self) -> dict[str, int]:
        """All counters of the process."""
        gaps: dict[str, int] = {}
        for topic, counter in self._gaps.values():
            for name, n in ((f"gap.{topic}", counter.lost), (f"restart.{topic}", counter.restarts)):
                if n:
                    gaps[name] = gaps.get(name, 0) + n
        return {**self.stage.counters, **self.inbox.counters, **self.outlet.counters, **self._counters, **gaps}

    def alarms(self) -> dict[str, str]:
        """What is wrong now: the stage's own alarms, inputs that have fallen silent, and falling behind."""
        now_s = time.monotonic()
        silent = {
            f"stale.{at}": f"nothing for {now_s - heard_s:.1f} s"
            for at, (topic, heard_s) in self._heard.items()
            if topic.stale_after_s and now_s - heard_s > topic.stale_after_s
        }
        behind = {} if (n := self.inbox.waiting()) < BEHIND else {"inbox.behind": f"{n} messages wait to be handled"}
        return {**alarms_of(self.stage), **silent, **behind}

    def gauges(self) -> dict[str, float]:
        """Values of now, unit in the name."""
        return gauges_of(self.stage)

    def role(self) -> str:
        """What the process is among those of its stage, where that can change."""
        return ""

    def token_changed(self, token: dict[str, str], *, is_there: bool) -> None:
        """A liveliness token, by its key's parts, came or went; for those who ``listen_to_tokens``."""
        raise NotImplementedError

    def every_round(self) -> None:
        """Called after each item, and at least every ``poll_s``."""

    def every_second(self) -> None:
        """Give back the memory of the dead, and publish the health of the period that ends."""
        self._pools.look(time.monotonic())
        health = self.health.report(self._t_ns, self.counters(), self.alarms(), self.role(), self.gauges())
        self.outlet.publish(HEALTH, health, worker=self.worker)

    # What all roles use ---------------------------------------------------------------------------------------

    def listen(self, stack: ExitStack, topic: Topic, at: str, *, urgent: bool = False) -> None:
        """Subscribe to one topic; its messages go through the inbox."""
        self.inbox.add_source(topic.name, self.depth, urgent, self._inbox_bytes)

        def arrived(sample: zenoh.Sample) -> None:
            self.inbox.put(topic.name, str(sample.key_expr), sample.payload.to_bytes())

        stack.enter_context(self.session.declare_subscriber(at, direct(arrived)))

    def listen_to_tokens(self, stack: ExitStack, **parts: str) -> None:
        """Hear of processes that come and go, those included that are there already."""
        self.inbox.add_source(_TOKENS, FIFO_DEPTH, urgent=True)

        def changed(sample: zenoh.Sample) -> None:
            came = sample.kind == zenoh.SampleKind.PUT
            self.inbox.put(_TOKENS, str(sample.key_expr), _CAME if came else _WENT)

        callback = direct(changed)
        tokens = self.session.liveliness().declare_subscriber(key(ALIVE, self.rig, **parts), callback, history=True)
        stack.enter_context(tokens)

    def count(self, name: str, text: str = "", *, with_trace: bool = False) -> None:
        """Count by name; with a text, log it the first time that this happens."""
        self._counters[name] = self._counters.get(name, 0) + 1
        if text and name not in self._logged:
            self._logged.add(name)
            log.warning("%s (further ones are only counted)", text, exc_info=with_trace)

    def take_other(self, item: Item) -> bool:
        """Handle an item that is no message; True if it was one."""
        return False

    def _wait_for_consumers(self, stop: Event) -> None:
        """Be alive only once what is published can arrive: a new link takes a moment to carry subscriptions."""
        for topic, where in self.consumers():
            if not stop.is_set() and not self.outlet.wait_for_subscriber(topic, CONSUMER_WAIT_S, **where):
                log.warning("nobody listens on %s yet", key(topic, self.rig, **where))

    def _take(self, item: Item) -> None:
        """One item of the inbox, whatever it is; nothing that is wrong with it gets further than here."""
        self.arrived_ns = item.t_ns
        try:
            if item.source == _TOKENS:
                self.token_changed(parts(ALIVE, item.key), is_there=item.data == _CAME)
                return
            if self.take_other(item):
                return
            topic = self._topics.get(item.source)
            envelope = decode(item.data, None if topic is None else topic.message, in_place=self.in_place)
        except WireError as e:
            self.count(e.reason, f"{item.key}: {e}")
            return
        if topic is None:
            self.received(item.source, envelope)
            return
        self._note_arrival(topic, item.key, envelope.message)
        outputs = self.survived(item.key, envelope, self.handle, envelope.message) or ()
        self.survived(item.key, envelope, self.publish, outputs, envelope)
        if self._tidying is not None:
            self.survived(item.key, envelope, self._tidying.tidy)

    def survived(self, at: str, cause: Envelope, do: Callable[..., T], *arguments: Any) -> T | None:
        """What ``do`` returns; None where it fails, as a worker outlives whatever one message does to it."""
        try:
            return do(*arguments)
        except Exception as e:
            name = f"error.{type(e).__name__}"
            self.count(name, f"{name} on {at}, seq {cause.message.seq}", with_trace=True)
            return None

    def _note_arrival(self, topic: Topic, at: str, message: Any) -> None:
        self.count(f"in.{topic.name}")
        self._heard[at] = (topic, time.monotonic())
        self._t_ns = max(self._t_ns, message.t_ns)
        if (overtaking := self.inputs[topic]) >= 0:
            if at not in self._gaps:
                self._gaps[at] = (topic.name, GapCounter(overtaking))
            self._see(self._gaps[at][1], message.seq)

    def _see(self, counter: GapCounter, seq: int) -> None:
        """Count what is missing; where an ordered stream starts anew, so do those that were made from it."""
        before = counter.restarts
        counter.see(seq)
        if counter.restarts > before:
            for _, other in self._gaps.values():
                if other.window:
                    other.forget()
