"""``velod echo`` and ``velod top``: look at a running velod from outside."""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from velod.cli.config import settings_of
from velod.cli.exit import EXIT_FAILED
from velod.cli.words import describe_attitude, describe_velocity
from velod.client import Listener, Received
from velod.config import ZenohSettings
from velod.runtime.access import RIGHTS
from velod.runtime.dispatching import SENT
from velod.runtime.session import introducer_endpoint, open_session
from velod.types import Health, Velocity
from velod.wire.topics import ANY_RIG, HEALTH, ODOMETRY, ODOMETRY_RESET, TOPICS, VELOCITY, key, parts

_CLEAR_SCREEN = "\x1b[H\x1b[2J"
_REFRESH_S = 1.0
_DISCOVERY_S = 3.0
_SILENCE_S = 3.0  # after which a user wonders


@dataclass(frozen=True, slots=True)
class Place:
    """Which velod: its rig's name, or ``*`` for all rigs, and how to reach it."""

    rig: str
    zenoh: ZenohSettings

    @property
    def connect(self) -> str:
        """The endpoint, or the file that names it."""
        return self.zenoh.config or self.zenoh.connect


@dataclass(frozen=True, slots=True)
class Way:
    """What the command line says of the way to a velod; what it leaves open the settings file says."""

    connect: str | None = None
    rig: str | None = None
    keys: str | None = None
    role: str | None = None
    insecure: bool = False


def place_of(config: str | None, way: Way, role: str) -> Place:
    """Where to look, as ``role`` unless said otherwise. Raises ConfigError."""
    settings = settings_of(config)
    zenoh = replace(
        settings.zenoh,
        connect=way.connect or introducer_endpoint(settings.zenoh),
        listen="",
        config="" if way.connect else settings.zenoh.config,
        keys=way.keys or settings.zenoh.keys,
        role=way.role or role,
        insecure=way.insecure or settings.zenoh.insecure,
    )
    return Place(way.rig or settings.rig.name, zenoh)


def echo(config: str | None, topic: str, way: Way, count: int | None, timeout_s: float | None) -> int:
    """Print the messages of a topic, and who is there where none comes; 1 if ``timeout_s`` passes without one."""
    readable = [t.name for t in TOPICS.values() if t.message is not None]
    if topic not in readable:
        raise ValueError(f"no topic {topic!r} to print; topics: {', '.join(readable)}")
    place = place_of(config, way, "consumer" if TOPICS[topic] in (VELOCITY, ODOMETRY) else "operator")
    with Listener(place.rig, (TOPICS[topic],), place.zenoh) as listener:
        printed = 0
        while count is None or printed < count:
            wait_s = math.inf if timeout_s is None else timeout_s
            received = listener.receive(min(wait_s, _SILENCE_S))
            if received is None and wait_s > _SILENCE_S:
                _tell_of_silence(listener, place, topic, _SILENCE_S)
                received = listener.receive(wait_s - _SILENCE_S)
            if received is None:
                _tell_of_silence(listener, place, topic, wait_s)
                return EXIT_FAILED
            whose = f"{parts(TOPICS[topic], received.key)['rig']}: " if place.rig == ANY_RIG else ""
            print(f"{whose}{describe(received)}", flush=True)
            printed += 1
    return 0


def _tell_of_silence(listener: Listener, place: Place, topic: str, seconds: float) -> None:
    said = f"velod: no {topic} of rig {place.rig} in {seconds:g} s ({place.connect})"
    # Behind certificates not everyone may see who is alive.
    if not place.connect.startswith("tls/") or RIGHTS[place.zenoh.role].sees:
        names = ", ".join(worker for _, worker in listener.alive())
        said += f"; at work: {names}" if names else "; no process of that rig is there"
    print(said, file=sys.stderr, flush=True)


def reset_odometry(config: str | None, way: Way) -> int:
    """Ask the optimizers to begin their dead reckoning anew; 1 if none answers."""
    place = place_of(config, way, "operator")
    deadline_s = time.monotonic() + _DISCOVERY_S
    done: list[str] = []
    with open_session(place.zenoh) as session:
        # A session that was just opened may not be linked to the optimizers yet; nobody answers it then.
        while not done and time.monotonic() < deadline_s:
            replies = session.get(key(ODOMETRY_RESET, place.rig), timeout=_DISCOVERY_S)
            done = [json.loads(reply.ok.payload.to_string())["reset_by"] for reply in replies if reply.ok is not None]
            time.sleep(0.0 if done else 0.02)
    if not done:
        print(f"velod: no optimizer of rig {place.rig} answers ({place.connect})", file=sys.stderr)
        return EXIT_FAILED
    print(f"reset by {', '.join(sorted(done))}: the next odometry begins at zero")
    return 0


def describe(received: Received) -> str:
    """One line for one message: velocities in words, others field by field."""
    message = received.envelope.message
    if isinstance(message, Velocity):
        return f"{describe_velocity(message, latency_ms=origin_latency_ms(received))}  {describe_attitude(message)}"
    shown = " ".join(f"{f.name}={_value(getattr(message, f.name))}" for f in fields(message))
    return f"{type(message).__name__} {shown}"


def origin_latency_ms(received: Received) -> float:
    """From the closing of the batch to the publication of the velocity, ms; NaN where there was no batch."""
    envelope = received.envelope
    return (envelope.t_pub_ns - envelope.t_origin_ns) * 1e-6 if envelope.t_origin_ns > 0 else math.nan


def _value(value: Any) -> str:
    if isinstance(value, np.ndarray) and value.size <= 4:
        return "[" + " ".join(f"{v:g}" for v in value.ravel().tolist()) + "]"
    if isinstance(value, np.ndarray):
        spread = f"{value.min():g}..{value.max():g}" if value.size else "-"
        return f"{value.dtype}{list(value.shape)}({spread})"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {v:g}" if isinstance(v, float) else f"{k}: {v}" for k, v in value.items()) + "}"
    return f"{value:g}" if isinstance(value, float) else str(value)


def top(config: str | None, way: Way, *, once: bool) -> int:
    """The table of processes, drawn once a second; with ``once`` printed one time, 1 if nobody answers."""
    place = place_of(config, way, "operator")
    with Listener(place.rig, (HEALTH,), place.zenoh) as listener:
        newest: dict[str, Received] = {}
        if once:
            _collect(listener, newest, _DISCOVERY_S, until_complete=True)
            print(table(place, newest, listener.alive()))
            return 0 if newest else EXIT_FAILED
        begin = _CLEAR_SCREEN if sys.stdout.isatty() else ""
        while True:
            _collect(listener, newest, _REFRESH_S, until_complete=False)
            print(begin + table(place, newest, listener.alive()), flush=True)


def _collect(listener: Listener, newest: dict[str, Received], seconds: float, *, until_complete: bool) -> None:
    """Take in health messages for a while, or until everyone who is alive has spoken."""
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0.0:
        received = listener.receive(min(0.2, left_s))
        if received is not None and isinstance(received.envelope.message, Health):
            newest[received.envelope.message.worker] = received
        elif until_complete and newest and {worker for _, worker in listener.alive()} <= set(newest):
            return


_HEADER = (
    f"{'worker':<14}{'state':<8}{'pid@host':<22}{'up s':>8}{'in/s':>8}{'out/s':>8}"
    f"{'p50 ms':>8}{'p99 ms':>8}{'gaps':>7}{'drops':>7}"
)


def table(place: Place, newest: dict[str, Received], alive: list[tuple[str, str]]) -> str:
    """The table as text: a line per process, the drops by cause, the alarms."""
    workers = {worker for _, worker in alive}
    lines = [f"velod rig {place.rig} at {place.connect}", _HEADER]
    for worker in sorted(set(newest) | workers):
        lines += _lines(worker, newest.get(worker), worker in workers)
    if len(lines) == 2:
        lines.append("nobody there")
    return "\n".join(lines)


def _lines(worker: str, received: Received | None, alive: bool) -> list[str]:
    if received is None:
        return [f"{worker:<14}{'silent':<8}"]
    h = received.envelope.message
    assert isinstance(h, Health)
    stale = (time.time_ns() - received.t_received_ns) * 1e-9 > HEALTH.stale_after_s
    # The supervisor and drivers hold no token; for them recent health is life enough.
    state = "stale" if stale else "up" if alive or h.stage not in ("ingest", "flow", "depth", "optimizer") else "gone"
    if state == "up" and h.role:
        state = h.role
    name, p50, p99 = _main_latency(h)
    gaps, drops = losses(h.counters)
    line = (
        f"{worker:<14}{state:<8}{f'{h.pid}@{h.host}'[:21]:<22}{h.uptime_s:8.0f}{_rate(h, 'in.'):8.1f}"
        f"{_rate(h, 'out.'):8.1f}{p50:>8}{p99:>8}{sum(gaps.values()):7d}{sum(drops.values()):7d}  {name}".rstrip()
    )
    notes = [f"    {cause}: {n}" for cause, n in sorted({**gaps, **drops}.items())]
    alarms = [f"    ALARM {alarm}: {what}" for alarm, what in sorted(h.alarms.items())]
    return [line, *shares(h.rates), *notes, *alarms]


def shares(rates: dict[str, float]) -> list[str]:
    """Who is sent how much of each stage's batches, by ingest's health: a line per stage."""
    by_stage: dict[str, dict[str, float]] = {}
    for name, rate in sorted(rates.items()):
        if name.startswith(SENT):
            worker = name.removeprefix(SENT)
            by_stage.setdefault(worker.partition("-")[0], {})[worker] = rate
    return [
        f"    {stage}: " + ", ".join(f"{worker} {rate / sum(part.values()):.0%}" for worker, rate in part.items())
        for stage, part in by_stage.items()
    ]


def _main_latency(h: Health) -> tuple[str, str, str]:
    """Name, p50 and p99 of the latency to show: end to end where there is one, else the first."""
    names = sorted({name.rpartition("_")[0] for name in h.latency_ms}, key=lambda n: (n != "end_to_end", n))
    for name in names:
        if f"{name}_p50" in h.latency_ms and f"{name}_p99" in h.latency_ms:
            return name, f"{h.latency_ms[f'{name}_p50']:.2f}", f"{h.latency_ms[f'{name}_p99']:.2f}"
    return "", "-", "-"


def _rate(h: Health, prefix: str) -> float:
    return sum(rate for name, rate in h.rates.items() if name.startswith(prefix))


_LOSS_PREFIXES = (
    *("packets.", "events.", "imu.", "clock.", "batch.", "batches.", "shed."),  # refused or missed by a stage
    *("inbox.", "dispatch.", "wire.", "key.", "error.", "restart."),  # on the way between processes
)


def losses(counters: dict[str, int]) -> tuple[dict[str, int], dict[str, int]]:
    """The gaps and the drops among a process's counters, those above zero; what merely counts work is neither."""
    gaps = {name: n for name, n in counters.items() if n and name.startswith(("gap.", "packets.gap"))}
    drops = {name: n for name, n in counters.items() if n and name not in gaps and name.startswith(_LOSS_PREFIXES)}
    return gaps, drops
