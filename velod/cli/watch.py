"""``velod echo`` and ``velod odometry``: listen to a running velod, and speak to it."""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import fields
from typing import Any

import numpy as np

from velod.cli.exit import EXIT_FAILED
from velod.cli.place import Place, Way, place_of
from velod.cli.words import describe_attitude, describe_velocity
from velod.client import Listener, Received
from velod.runtime.access import RIGHTS
from velod.runtime.session import open_session
from velod.types import Velocity
from velod.wire.topics import ANY_RIG, ODOMETRY, ODOMETRY_RESET, TOPICS, VELOCITY, key, parts

_SILENCE_S = 3.0  # after which a user wonders
_DISCOVERY_S = 3.0


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


def _tell_of_silence(listener: Listener, place: Place, topic: str, seconds: float) -> None:
    said = f"velod: no {topic} of rig {place.rig} in {seconds:g} s ({place.connect})"
    # Behind certificates not everyone may see who is alive.
    if not place.connect.startswith("tls/") or RIGHTS[place.zenoh.role].sees:
        names = ", ".join(worker for _, worker in listener.alive())
        said += f"; at work: {names}" if names else "; no process of that rig is there"
    print(said, file=sys.stderr, flush=True)


def _value(value: Any) -> str:
    if isinstance(value, np.ndarray) and value.size <= 4:
        return "[" + " ".join(f"{v:g}" for v in value.ravel().tolist()) + "]"
    if isinstance(value, np.ndarray):
        spread = f"{value.min():g}..{value.max():g}" if value.size else "-"
        return f"{value.dtype}{list(value.shape)}({spread})"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {v:g}" if isinstance(v, float) else f"{k}: {v}" for k, v in value.items()) + "}"
    return f"{value:g}" if isinstance(value, float) else str(value)
