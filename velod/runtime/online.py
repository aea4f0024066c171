"""A whole service for the length of one driver's run: supervisor, driver process, and what came out of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from threading import Event

import numpy as np
import zenoh

from velod.config import Settings
from velod.geometry.calibration import Calibration
from velod.runtime.callbacks import direct
from velod.runtime.inbox import Inbox, Item
from velod.runtime.measure import GapCounter
from velod.runtime.process import ChildProcess, LineSink, stop_all, to_stderr
from velod.runtime.supervisor import Supervisor
from velod.types import Health, Message, Velocity
from velod.wire import Envelope, WireError, decode
from velod.wire.topics import HEALTH, VELOCITY, Topic, key

START_S = 180.0
POLL_S = 0.02
_COLLECTED = 1 << 20
_READ_AT_ONCE = (VELOCITY.name, HEALTH.name)
_LOSSES = (
    "gap.",
    "inbox.",
    "dispatch.overflow",
    "dispatch.stale",
    "shed.",
    "wire.",
    "error.",
    "packets.gap",
    "packets.late",
    "batch.lost",
)


class OnlineError(RuntimeError):
    """The run failed; the text says which process, and why."""


@dataclass(frozen=True, slots=True)
class Published:
    """A velocity with the host times of its publication and of its newest batch's closing (0: no batch), ns."""

    velocity: Velocity
    t_pub_ns: int
    t_origin_ns: int


@dataclass(slots=True)
class OnlineResult:
    """What a run put out, and what its processes said of themselves."""

    velocities: list[Published] = field(default_factory=list)
    health: dict[str, Health] = field(default_factory=dict)  # the last one of each process, by worker
    restarts: dict[str, int] = field(default_factory=dict)  # by worker
    gaps: int = 0  # velocities that this collector missed
    wall_s: float = 0.0  # from the driver's first moment to its end

    def latency_ms(self) -> np.ndarray:
        """Batch closed -> velocity out, for the first velocity that uses each batch, ms."""
        before, out = (-1, 0), []
        for p in self.velocities:
            batch = (p.velocity.batch_seq, p.velocity.batch_t_ns)
            if batch != before and p.t_origin_ns:
                out.append((p.t_pub_ns - p.t_origin_ns) * 1e-6)
            before = batch
        return np.array(out)

    def latency_percentiles_ms(self) -> tuple[float, float] | None:
        """p50 and p99 of ``latency_ms``; None without a velocity that used a batch."""
        latency = self.latency_ms()
        if not len(latency):
            return None
        p50, p99 = np.percentile(latency, (50, 99))
        return float(p50), float(p99)

    def drops(self) -> dict[str, int]:
        """Everything that was lost anywhere, as ``<worker>: <counter>``; empty where nothing was."""
        return {
            f"{worker}: {name}": n
            for worker, health in sorted(self.health.items())
            for name, n in sorted(health.counters.items())
            if n and name.startswith(_LOSSES)
        }


def run_online(
    settings: Settings,
    calibration: Calibration,
    driver_command: Sequence[str],
    on_velocity: Callable[[Published], None] | None = None,
    *,
    on_message: Callable[[Message], None] | None = None,
    on_envelope: Callable[[Envelope], None] | None = None,
    topics: Iterable[Topic] = (),
    on_step: Callable[[Supervisor], None] | None = None,
    on_line: LineSink = to_stderr,
    spare: bool = True,
    stop: Event | None = None,
) -> OnlineResult:
    """Start the service, run the driver to its end, stop everything.

    ``on_velocity`` is called with each velocity, ``on_message`` with each message of further ``topics``, ``on_step``
    every 20 ms or so, all in this thread; ``on_envelope`` instead of ``on_message`` when the run is over, with host
    times as well, so that reading them takes nothing from it: until then they are kept in memory. Setting ``stop``
    ends the run early. Raises OnlineError, SessionError.
    """
    result = OnlineResult()
    with Supervisor(settings, calibration, spare=spare, on_line=on_line) as supervisor:
        collector = _Collector(result, settings.rig.name, on_velocity, on_message, on_envelope)
        collector.subscribe(supervisor.session, (VELOCITY, HEALTH, *topics))
        _wait_until_up(supervisor, collector, stop)
        started_s = time.monotonic()
        with ExitStack() as stack:
            driver = ChildProcess(driver_command, on_line)
            stack.callback(stop_all, [driver])
            while driver.exit_code() is None and not (stop is not None and stop.is_set()):
                _step(supervisor, collector)
                if on_step is not None:
                    on_step(supervisor)
            result.wall_s = time.monotonic() - started_s
            if driver.exit_code():
                raise OnlineError(f"the driver failed: {driver.why()}")
        collector.drain(time.monotonic() + 10 * POLL_S)
        result.restarts = supervisor.restarts()
        supervisor.stop_workers()
        collector.drain(time.monotonic() + 10 * POLL_S)
    collector.read_kept()
    return result


def _wait_until_up(supervisor: Supervisor, collector: _Collector, stop: Event | None) -> None:
    deadline_s = time.monotonic() + START_S
    while not (supervisor.is_up() and supervisor.spare_is_settled) and not (stop is not None and stop.is_set()):
        _step(supervisor, collector)
        if time.monotonic() > deadline_s:
            raise OnlineError(f"the service is not up after {START_S:.0f} s")


def _step(supervisor: Supervisor, collector: _Collector) -> None:
    supervisor.step()
    if trouble := supervisor.trouble():
        raise OnlineError(trouble)
    collector.drain(time.monotonic() + POLL_S)


class _Collector:
    """Subscribes in the supervisor's session and sorts what comes in."""

    def __init__(
        self,
        result: OnlineResult,
        rig: str,
        on_velocity: Callable[[Published], None] | None,
        on_message: Callable[[Message], None] | None,
        on_envelope: Callable[[Envelope], None] | None,
    ) -> None:
        self._result, self._rig = result, rig
        self._on_velocity, self._on_message, self._on_envelope = on_velocity, on_message, on_envelope
        self._inbox = Inbox()
        self._kept: list[Item] = []
        self._gaps = GapCounter()

    def subscribe(self, session: zenoh.Session, topics: Iterable[Topic]) -> None:
        """Listen until the session closes."""
        for topic in topics:
            self._listen(session, topic)

    def drain(self, until_s: float) -> None:
        """Handle everything that comes in until then (monotonic clock)."""
        while (left_s := until_s - time.monotonic()) > 0.0:
            item = self._inbox.get(left_s)
            if item is not None:
                self._take(item)

    def _listen(self, session: zenoh.Session, topic: Topic) -> None:
        self._inbox.add_source(topic.name, _COLLECTED)

        def arrived(sample: zenoh.Sample) -> None:
            self._inbox.put(topic.name, str(sample.key_expr), sample.payload.to_bytes())

        session.declare_subscriber(key(topic, self._rig), direct(arrived))

    def read_kept(self) -> None:
        """Hand over what was kept until the end of the run."""
        for item in self._kept:
            if self._on_envelope is not None and (envelope := _decoded(item)) is not None:
                self._on_envelope(envelope)
        self._kept.clear()

    def _take(self, item: Item) -> None:
        if self._on_envelope is not None and item.source not in _READ_AT_ONCE:
            self._kept.append(item)
            return
        if (envelope := _decoded(item)) is None:
            return
        message = envelope.message
        if isinstance(message, Velocity):
            self._gaps.see(message.seq)
            self._result.gaps = self._gaps.lost
            published = Published(message, envelope.t_pub_ns, envelope.t_origin_ns)
            self._result.velocities.append(published)
            if self._on_velocity is not None:
                self._on_velocity(published)
        elif isinstance(message, Health):
            self._result.health[message.worker] = message
        elif self._on_message is not None:
            self._on_message(message)


def _decoded(item: Item) -> Envelope | None:
    """None for the message of an alien publisher: those whom it concerns count it."""
    try:
        return decode(item.data)
    except WireError:
        return None
