"""``velod prove attacks``: what outsiders may try, each tried on a velod at work, and what became of it.

An attempt is repelled if it had no effect inside. The service must be the same processes afterwards, and its consumer
must have been served all along.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import zenoh

from velod.prove.besieged import OTHER_RIG, RIG, STAGES, Besieged
from velod.prove.processes import resident_mib
from velod.runtime.certificates import Authority, new_authority, new_certificate, read_authority, write_pair
from velod.runtime.endpoints import parse
from velod.runtime.key_paths import KeyPaths
from velod.runtime.verdict import tls_verdict
from velod.types import ImuPacket, Velocity
from velod.wire import encode
from velod.wire.topics import ALIVE, CONFIG, EVENTS, IMU_SENSOR, VELOCITY, key

SETTLE_S = 0.5
"""A message on loopback has arrived by then, or never will."""
_FORGED_SEQ = 666_666
_MIB = 1 << 20
_FLOOD = 30
MAX_GAP_S = 1.0
MAX_GROWTH_MIB = 400.0
"""Of one process during all attacks: ingest may hold half of its inbox's limit in garbage, its neighbours none."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """One attempt: who tried what, and what happened."""

    attempt: str
    holder: str
    happened: str
    repelled: bool


@dataclass(frozen=True, slots=True)
class Siege:
    """All attempts, and the state of the service afterwards."""

    outcomes: list[Outcome]
    died: list[str]  # workers that are not the process any more that they were
    served: int  # velocities at the consumer meanwhile
    longest_gap_s: float  # between two of them
    growth_mib: dict[str, float]  # resident memory, by worker

    def failures(self) -> list[str]:
        """What should not have happened; empty: nothing passed, nothing died."""
        found = [f"{o.holder}: {o.attempt}: {o.happened}" for o in self.outcomes if not o.repelled]
        found += [f"{worker} died" for worker in self.died]
        if self.longest_gap_s > MAX_GAP_S:
            found.append(f"the consumer waited {self.longest_gap_s:.1f} s for a velocity")
        found += [f"{w} grew by {mib:.0f} MiB" for w, mib in self.growth_mib.items() if mib > MAX_GROWTH_MIB]
        return found


def besiege(recording: Path, speed: float) -> Siege:
    """Try everything on a service that works on ``recording``, which has to last. Raises SiegeError."""
    with Besieged(recording, speed) as target, TemporaryDirectory(prefix="velod-forged-") as forged:
        pids, before_mib = target.process_ids(), _resident_mib(target)
        heard = target.n_heard()
        outcomes = [attempt(target, Path(forged)) for attempt in ATTEMPTS]
        time.sleep(1.5)  # one more health message of each
        after = target.process_ids()
        return Siege(
            outcomes,
            [worker for worker, pid in pids.items() if after.get(worker) != pid or not Path(f"/proc/{pid}").exists()],
            target.n_heard() - heard,
            target.longest_gap().seconds,
            {w: mib - before_mib[w] for w, mib in _resident_mib(target).items() if w in before_mib},
        )


# --- without a certificate of ours ---


def _no_certificate(target: Besieged, forged: Path) -> Outcome:
    def connect() -> zenoh.Session:
        return target.outsider(target.keys, "consumer", wait_ms=1500, shows=False)

    return _refused("connect", "nobody (no certificate)", connect, "")


def _other_authority(target: Besieged, forged: Path) -> Outcome:
    files = _forge(target, forged / "other", new_authority(), "velod-consumer")
    return _refused_with(target, files, "connect", "consumer of another CA")


def _expired(target: Besieged, forged: Path) -> Outcome:
    files = _forge(target, forged / "expired", read_authority(target.keys), "velod-consumer", days=-1.0)
    return _refused_with(target, files, "connect", "consumer, expired")


def _unknown_role(target: Besieged, forged: Path) -> Outcome:
    files = _forge(target, forged / "visitor", read_authority(target.keys), "velod-visitor")
    return _reads_nothing(target, files, "consumer", "visitor (no role)", key(VELOCITY, RIG), "subscribe to velocity")


def _noise(target: Besieged, forged: Path) -> Outcome:
    endpoint = parse(target.endpoint, "target")
    for _ in range(20):
        with socket.create_connection((endpoint.host, endpoint.port), 1.0) as link:
            try:
                link.sendall(os.urandom(_MIB))
            except OSError:
                continue  # it hung up, as it should
    return Outcome("20 MiB of noise to the TLS port", "nobody", "hung up on", repelled=True)


# --- with a certificate, beyond its role ---


def _forged_velocity(role: str) -> Callable[[Besieged, Path], Outcome]:
    def attempt(target: Besieged, forged: Path) -> Outcome:
        data = encode(_velocity(), time.time_ns())
        return _arrives_nowhere(target, target.keys, role, role, key(VELOCITY, RIG), [data], "forge a velocity")

    return attempt


def _other_rigs_velocity(target: Besieged, forged: Path) -> Outcome:
    data, at = encode(_velocity(), time.time_ns()), key(VELOCITY, RIG)
    folder = target.keys / OTHER_RIG
    return _arrives_nowhere(target, folder, "worker", f"worker of {OTHER_RIG}", at, [data], f"forge {RIG}'s velocity")


def _forged_imu(target: Besieged, forged: Path) -> Outcome:
    packet = ImuPacket(_FORGED_SEQ, 1, np.array([1]), np.zeros((1, 3)), np.zeros((1, 3)))
    data, at = encode(packet, time.time_ns()), key(IMU_SENSOR, RIG)
    return _arrives_nowhere(target, target.keys, "consumer", "consumer", at, [data], "forge IMU samples")


def _raw_events(target: Besieged, forged: Path) -> Outcome:
    what = "subscribe to raw events"
    return _reads_nothing(target, target.keys, "consumer", "consumer", key(EVENTS, RIG), what)


def _everything(target: Besieged, forged: Path) -> Outcome:
    return _reads_nothing(target, target.keys, "operator", "operator", "velod/*/batch/**", "subscribe to batches")


def _velocity_as_driver(target: Besieged, forged: Path) -> Outcome:
    return _reads_nothing(target, target.keys, "driver", "driver", key(VELOCITY, RIG), "subscribe to velocity")


def _false_worker(target: Besieged, forged: Path) -> Outcome:
    token = key(ALIVE, RIG, stage="flow", worker="flow-9")
    with target.outsider(target.keys, "consumer") as session, session.liveliness().declare_token(token):
        time.sleep(SETTLE_S)
        seen = [r for r in target.insider.liveliness().get(token, timeout=1.0) if r.ok is not None]
    happened = "is taken for one" if seen else "nobody sees it"
    return Outcome("pose as a flow worker", "consumer", happened, repelled=not seen)


def _false_settings(target: Besieged, forged: Path) -> Outcome:
    at = key(CONFIG, RIG)
    with target.outsider(target.keys, "consumer") as session:
        queryable = session.declare_queryable(at, lambda query: query.reply(at, '{"forged": true}'))
        time.sleep(SETTLE_S)
        answers = [r.ok.payload.to_string() for r in target.insider.get(at, timeout=1.0) if r.ok is not None]
        del queryable
    passed = any("forged" in answer for answer in answers)
    happened = "answered" if passed else f"nobody asks it; {len(answers)} true answer"
    return Outcome("answer for the settings", "consumer", happened, repelled=not passed)


# --- within its role, with ill will ---


def _large(role: str) -> Callable[[Besieged, Path], Outcome]:
    def attempt(target: Besieged, forged: Path) -> Outcome:
        at, data = key(EVENTS, RIG, camera="left"), bytes(10 * _MIB)
        what = f"{_FLOOD} messages of 10 MiB as events"
        return _arrives_nowhere(target, target.keys, role, role, at, [data] * _FLOOD, what)

    return attempt


def _refused_by_decoder(what: str, data: Callable[[], bytes], n: int = 20) -> Callable[[Besieged, Path], Outcome]:
    def attempt(target: Besieged, forged: Path) -> Outcome:
        before = target.counted("ingest-0", "wire.")
        with target.outsider(target.keys, "driver") as session:
            publisher = session.declare_publisher(
                key(IMU_SENSOR, RIG), congestion_control=zenoh.CongestionControl.BLOCK
            )
            time.sleep(SETTLE_S)
            payload = data()
            for _ in range(n):
                publisher.put(payload)
            deadline_s = time.monotonic() + 6.0
            while (refused := target.counted("ingest-0", "wire.") - before) < n and time.monotonic() < deadline_s:
                time.sleep(0.1)
        return Outcome(what, "driver", f"{refused} of {n} refused by name and counted", repelled=refused == n)

    return attempt


def _truncated() -> bytes:
    return encode(ImuPacket(0, 1, np.array([1]), np.zeros((1, 3)), np.zeros((1, 3))), 1)[:-5]


def _of_the_future() -> bytes:
    return encode(ImuPacket(0, 1, np.array([1]), np.zeros((1, 3)), np.zeros((1, 3))), 1).replace(
        b"\xa1v\x01", b"\xa1v\x02"
    )


ATTEMPTS: tuple[Callable[[Besieged, Path], Outcome], ...] = (
    _no_certificate,
    _other_authority,
    _expired,
    _unknown_role,
    _noise,
    _forged_velocity("consumer"),
    _forged_velocity("operator"),
    _forged_velocity("driver"),
    _other_rigs_velocity,
    _forged_imu,
    _raw_events,
    _everything,
    _velocity_as_driver,
    _false_worker,
    _false_settings,
    _large("consumer"),
    _large("driver"),
    _refused_by_decoder("a flood of 1 MiB of garbage each", lambda: os.urandom(_MIB), n=200),
    _refused_by_decoder("malformed msgpack", lambda: b"\xdf\xff\xff\xff\xff\xc1\x00"),
    _refused_by_decoder("a message cut short", _truncated),
    _refused_by_decoder("a schema of the future", _of_the_future),
)


# --- how it is tried, and seen ---


def _refused(what: str, holder: str, open_it: Callable[[], zenoh.Session], said: str) -> Outcome:
    try:
        with open_it():
            return Outcome(what, holder, "connected", repelled=False)
    except zenoh.ZError:
        return Outcome(what, holder, f"no connection{f': {said}' if said else ''}", repelled=True)


def _refused_with(target: Besieged, folder: Path, what: str, holder: str) -> Outcome:
    said = tls_verdict(parse(target.endpoint, "target"), KeyPaths(folder), "consumer").partition(": ")[2]
    return _refused(what, holder, lambda: target.outsider(folder, "consumer", wait_ms=1500), said)


def _arrives_nowhere(
    target: Besieged, folder: Path, role: str, holder: str, at: str, payloads: list[bytes], what: str
) -> Outcome:
    sent = {len(p) for p in payloads} if len(payloads) > 1 else set()
    with _heard(target, at) as heard, target.outsider(folder, role) as session:
        publisher = session.declare_publisher(at, congestion_control=zenoh.CongestionControl.BLOCK)
        time.sleep(SETTLE_S)
        for payload in payloads:
            publisher.put(payload)
        time.sleep(SETTLE_S)
    passed = sum(data in payloads if not sent else len(data) in sent for data in heard)
    return Outcome(what, holder, f"{passed} of {len(payloads)} arrived", repelled=passed == 0)


def _reads_nothing(target: Besieged, folder: Path, role: str, holder: str, at: str, what: str) -> Outcome:
    got: list[zenoh.Sample] = []
    with target.outsider(folder, role) as session, session.declare_subscriber(at, got.append):
        time.sleep(3 * SETTLE_S)
    return Outcome(what, holder, f"{len(got)} messages received", repelled=not got)


@contextmanager
def _heard(target: Besieged, at: str) -> Iterator[list[bytes]]:
    """What arrives inside."""
    got: list[bytes] = []
    with target.insider.declare_subscriber(at, lambda sample: got.append(sample.payload.to_bytes())):
        time.sleep(SETTLE_S)
        yield got


def _forge(target: Besieged, folder: Path, authority: Authority, name: str, days: float = 1.0) -> Path:
    """A folder with the true CA's certificate and one of ``authority`` that says ``name``."""
    folder.mkdir()
    files = KeyPaths(folder)
    files.ca.write_bytes(KeyPaths(target.keys).ca.read_bytes())
    write_pair(files.certificate("consumer"), files.key("consumer"), *new_certificate(authority, name, days=days))
    return folder


def _velocity() -> Velocity:
    return Velocity(_FORGED_SEQ, 1, np.full(3, 99.0), np.eye(3), True, "tracking", "", 0, 0)


def _resident_mib(target: Besieged) -> dict[str, float]:
    """Of the workers and of the process that faces the network."""
    pids = {w: pid for w, pid in target.process_ids().items() if w in (*STAGES, "supervisor")}
    return {worker: resident_mib(pid) for worker, pid in pids.items()}
