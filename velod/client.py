"""Receive what velod publishes: five lines to a stream of velocities.

>>> from velod.client import VelocityClient
>>> with VelocityClient("rig0", connect="tcp/127.0.0.1:17447") as client:
...     for velocity in client:
...         print(velocity.t_ns, velocity.v_B)
"""

from __future__ import annotations

import logging
import math
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from velod.config import ZenohSettings
from velod.runtime.access import may_read
from velod.runtime.callbacks import direct
from velod.runtime.inbox import Inbox
from velod.runtime.measure import GapCounter, HostClocks
from velod.runtime.session import SessionError, open_session
from velod.runtime.stacked import Stacked
from velod.runtime.staleness import StaleStream
from velod.types import Velocity
from velod.wire import Envelope, WireError, decode
from velod.wire.topics import ALIVE, ANY_RIG, DEPTH, DONE, FLOW, VELOCITY, VELOCITY_AGAIN, Topic, key, parts

log = logging.getLogger("velod.client")

LOCAL = "tcp/127.0.0.1:17447"
"""Where a velod with default settings is found from its own host."""

CLOCK_RESTART_NS = 10_000_000_000
"""So far back in time the sensor's clock was set anew; what is less far back has been before."""

_POLL_S = 0.5
_OF = "@"
# Several workers publish on these keys, and batches overtake each other.
_OVERTAKING = {FLOW.name: 16, DEPTH.name: 16, DONE.name: 16}


@dataclass(frozen=True, slots=True)
class Received:
    """One message as it came in."""

    topic: Topic
    key: str
    envelope: Envelope
    t_received_ns: int  # host clock
    n_bytes: int

    @property
    def age_s(self) -> float:
        """From publication to arrival, by the host clocks; across hosts these must be synchronised (PTP, NTP)."""
        return (self.t_received_ns - self.envelope.t_pub_ns) * 1e-9


class Listener(Stacked):
    """Messages of any topics of one rig, or of all (``"*"``). A context manager; nothing is received outside it.

    The connection is made, and made again after a loss, in the background. Each topic keeps the newest
    ``topic.qos.depth`` messages; with ``queue_bytes``, for those who must miss none, as many as so many bytes hold.
    To enter it raises velod.runtime.session.SessionError: endpoint malformed, certificate or role of no use, refused.
    """

    def __init__(
        self, rig: str, topics: tuple[Topic, ...], settings: ZenohSettings, queue_bytes: int | None = None
    ) -> None:
        self._refused: dict[str, int] = {}
        self._rig = rig
        self._topics = {t.name: t for t in topics}
        self._settings = settings
        self._queue_bytes = queue_bytes
        self._inbox = Inbox()
        self._gaps: dict[tuple[str, str], GapCounter] = {}  # by topic and key
        self._session: Any = None

    def _open(self, stack: ExitStack) -> None:
        role = self._settings.role
        for topic in self._topics.values():
            if self._settings.connect.startswith("tls/") and not may_read(role, topic):
                raise SessionError(f"the role {role} may not read {topic.name}")
        self._session = stack.enter_context(open_session(self._settings))
        for topic in self._topics.values():
            stack.enter_context(self._subscribe(topic))
        stack.callback(self._forget_session)

    def _forget_session(self) -> None:
        self._session = None

    def _subscribe(self, topic: Topic) -> Any:
        # A queue for each rig: a hundred rigs must not push each other's newest messages out of one.
        sources: dict[str, str] = {}  # by key

        def arrived(sample: Any) -> None:
            at = str(sample.key_expr)
            if (source := sources.get(at)) is None:
                rig = parts(topic, at)["rig"]
                source = topic.name if self._rig != ANY_RIG else f"{topic.name}{_OF}{rig}"
                if source not in sources.values():
                    depth = topic.qos.depth if self._queue_bytes is None else sys.maxsize
                    self._inbox.add_source(source, depth, max_bytes=self._queue_bytes)
                sources[at] = source
            self._inbox.put(source, at, sample.payload.to_bytes())

        return self._session.declare_subscriber(key(topic, self._rig), direct(arrived))

    def receive(self, timeout_s: float = math.inf) -> Received | None:
        """The next message that can be read; None after ``timeout_s`` without one."""
        deadline_s = time.monotonic() + timeout_s
        while self._session is not None:
            # In steps, so that a signal is seen and an infinite timeout is possible.
            item = self._inbox.get(min(_POLL_S, max(0.0, deadline_s - time.monotonic())))
            if item is not None:
                received = self._decode(item.source, item.key, item.data, item.t_ns)
                if received is not None:
                    return received
            elif time.monotonic() >= deadline_s:
                return None
        return None

    def alive(self) -> list[tuple[str, str]]:
        """(stage, worker) of every process that is there now, sorted. Empty: no velod was reached."""
        if self._session is None:
            return []
        replies = self._session.liveliness().get(key(ALIVE, self._rig), timeout=1.0)
        found = [parts(ALIVE, str(reply.ok.key_expr)) for reply in replies if reply.ok is not None]
        return sorted((p["stage"], p["worker"]) for p in found)

    def _decode(self, source: str, found: str, data: bytes, t_ns: int) -> Received | None:
        topic = self._topics[source.partition(_OF)[0]]
        try:
            envelope = decode(data, topic.message)
        except WireError as e:
            self._refused[e.reason] = self._refused.get(e.reason, 0) + 1
            return None
        if topic.rate_hz:  # of what is sent on demand no message follows from the one before
            gaps = self._gaps.setdefault((topic.name, found), GapCounter(_OVERTAKING.get(topic.name, 0)))
            gaps.see(envelope.message.seq)
        return Received(topic, found, envelope, t_ns, len(data))

    @property
    def counters(self) -> dict[str, int]:
        """What was lost, by cause.

        ``gap.<topic>``: messages missing in a publisher's ``seq``; ``restart.<topic>``: publishers that began anew;
        ``inbox.overflow.<topic>``: taken too slowly; ``wire.*``: refused by the decoder.
        """
        counts = {**self._inbox.counters, **self._refused}
        for (topic, _), gaps in self._gaps.items():
            for name, n in ((f"gap.{topic}", gaps.lost), (f"restart.{topic}", gaps.restarts)):
                if n:
                    counts[name] = counts.get(name, 0) + n
        return counts


class VelocityClient(Stacked):
    """The stream of velocities of one rig, or of all (``"*"``): ``rig`` then says whose velocity was the last one.

    A context manager and an endless iterable of valid velocities (``valid_only=False``: of all), in order of sensor
    time. Reconnects by itself. Velocities older than ``max_age_s`` when they are handed out are discarded and
    counted as ``stale``, invalid ones as ``invalid``, and those of a time that was handed out already as
    ``repeated``. What a stand-by that takes over sends again, beside, fills the gap that its predecessor may have
    left. Where for a second all are stale, the log ``velod.client`` says so and why. Each has the age at which it is
    handed out, ``age_ms``: NaN where it cannot be known, because the publisher's clock is not in step with this
    host's (counted as ``age.unknown``; such are not stale, whatever they are). ``max_age_s = math.inf`` keeps
    everything, as for a replay in slow motion. ``tls/`` endpoints need ``keys``, a folder with certificates; ``tcp/``
    ones on other hosts have to be allowed with ``insecure``. To enter it raises velod.runtime.session.SessionError:
    endpoint malformed, certificate of no use, TLS refused.
    """

    def __init__(
        self,
        rig: str = "rig0",
        connect: str = LOCAL,
        max_age_s: float = 0.2,
        *,
        valid_only: bool = True,
        keys: str = "",
        role: str = "consumer",
        insecure: bool = False,
    ) -> None:
        settings = ZenohSettings(connect=connect, keys=keys, role=role, insecure=insecure)
        self._listener = Listener(rig, (VELOCITY, VELOCITY_AGAIN), settings)
        self.rig = rig
        self._max_age_s = max_age_s
        self._valid_only = valid_only
        self._counted: dict[str, int] = {}
        self._t_ns: dict[str, int] = {}  # by rig: sensor time of the newest one handed out
        self._clocks: defaultdict[str, HostClocks] = defaultdict(HostClocks)  # by rig
        self._streams: defaultdict[str, StaleStream] = defaultdict(StaleStream)  # by rig

    def _open(self, stack: ExitStack) -> None:
        stack.enter_context(self._listener)

    def __iter__(self) -> Iterator[Velocity]:
        while (velocity := self.receive()) is not None:
            yield velocity

    def receive(self, timeout_s: float = math.inf) -> Velocity | None:
        """The next velocity; None after ``timeout_s`` without one, and outside the ``with`` block."""
        deadline_s = time.monotonic() + timeout_s
        while (received := self._listener.receive(max(0.0, deadline_s - time.monotonic()))) is not None:
            velocity = received.envelope.message
            if not isinstance(velocity, Velocity):
                continue
            rig = parts(received.topic, received.key)["rig"]
            way_ms = self._way_ms(rig, received)
            why = self._why_not(rig, velocity, way_ms)
            if received.topic is VELOCITY:  # nothing is lost of what was sent once more
                self._note(rig, why, received, velocity.age_ms, way_ms)
            if why:
                continue
            self._t_ns[rig] = velocity.t_ns
            self.rig = rig
            if math.isnan(age_ms := velocity.age_ms + way_ms):
                self._count("age.unknown")
            return replace(velocity, age_ms=age_ms)
        return None

    def _why_not(self, rig: str, velocity: Velocity, way_ms: float) -> str:
        """Why a velocity is not handed out; empty where it is."""
        newest_t_ns = self._t_ns.get(rig, -CLOCK_RESTART_NS)
        # A publisher that does not know the age of what it sends leaves the way to be judged alone.
        if np.nansum([velocity.age_ms, way_ms]) > 1e3 * self._max_age_s:
            return "stale"
        if newest_t_ns - CLOCK_RESTART_NS < velocity.t_ns <= newest_t_ns:
            return "repeated"
        return "invalid" if self._valid_only and not velocity.valid else ""

    def _note(self, rig: str, why: str, received: Received, published_ms: float, way_ms: float) -> None:
        """Count what is not handed out; where all of it is stale, tell so."""
        if why:
            self._count(why)
        if why != "stale":
            self._streams[rig].fresh()
            return
        waited_ms = (time.time_ns() - received.t_received_ns) * 1e-6
        if cause := self._streams[rig].stale(published_ms, way_ms - waited_ms, waited_ms, time.monotonic_ns()):
            log.warning("all velocities of %s are older than max_age_s (%g s): %s", rig, self._max_age_s, cause)

    def _way_ms(self, rig: str, received: Received) -> float:
        """From publication to now, when it is handed out: it may have waited in the queue. NaN: not known."""
        clocks = self._clocks[rig]
        clocks.heard(received.envelope.t_pub_ns, received.t_received_ns)
        now_ns = time.time_ns()
        return (now_ns - received.envelope.t_pub_ns) * 1e-6 if clocks.agree(now_ns) else math.nan

    @property
    def counters(self) -> dict[str, int]:
        """What was not handed out, by cause: stale, invalid, gap.velocity, restart.velocity, wire.*, ...

        And what was, without an age: age.unknown.
        """
        return {**self._listener.counters, **self._counted}

    def _count(self, why: str) -> None:
        self._counted[why] = self._counted.get(why, 0) + 1
