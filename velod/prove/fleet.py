"""``velod prove fleet``: many rigs publish velocity through one router to one consumer; rate, latency and CPU."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from tempfile import TemporaryDirectory

import numpy as np

from velod.client import Listener
from velod.config import ZenohSettings
from velod.prove.besieged import free_port
from velod.prove.processes import cpu_s, resident_mib
from velod.runtime.certificates import make_keys
from velod.wire.topics import ANY_RIG, VELOCITY

RIGS_PER_PROCESS = 100
START_S = 60.0
_WARM_UP_S = 1.0


@dataclass(frozen=True, slots=True)
class Fleet:
    """What came of a fleet."""

    rigs: int
    hz: float  # of each
    seconds: float
    rate_hz: float  # of velocities at the consumer
    silent: int  # rigs that it never heard
    lost: int  # by holes in seq
    overflowed: int  # of these, in the consumer's queues: it was too slow, and kept the newest of each rig
    latency_p50_ms: float  # published to received
    latency_p99_ms: float
    router_cores: float  # CPU seconds per second
    rigs_cores: float
    consumer_cores: float
    router_mib: float

    @property
    def share(self) -> float:
        """Of what should have come."""
        return self.rate_hz / (self.rigs * self.hz)


class FleetError(RuntimeError):
    """The processes did not come up; one line."""


def run_fleet(rigs: int, hz: float, seconds: float, *, tls: bool = False) -> Fleet:
    """A router, processes of simulated rigs with a session each, and a consumer of ``velod/*/velocity`` here.

    ``tls``: with certificates and the list of what each may do, as between hosts. Raises FleetError.
    """
    with ExitStack() as stack:
        way = _tls(stack) if tls else _plain()
        router = _start(stack, ["velod.cli", "router", *way.router])
        assert router.stderr is not None
        if "up" not in (said := router.stderr.readline()):
            raise FleetError(f"the router is not up: {said.strip()}")
        listener = stack.enter_context(Listener(ANY_RIG, (VELOCITY,), way.consumer))
        groups = []
        for first in range(0, rigs, RIGS_PER_PROCESS):
            count = min(RIGS_PER_PROCESS, rigs - first)
            numbers = [str(first), str(count), f"{hz:g}"]
            groups.append(_start(stack, ["velod.prove.fleet_rigs", way.consumer.connect, *numbers, *way.rigs]))
        for group in groups:
            assert group.stdout is not None
            if group.stdout.readline() != "connected\n":
                raise FleetError(f"rigs did not connect; exit code {group.poll()}")
        for group in groups:
            assert group.stdin is not None
            group.stdin.write("go\n")
            group.stdin.flush()
        return _measure(listener, rigs, hz, seconds, router.pid, [group.pid for group in groups])


@dataclass(frozen=True, slots=True)
class _Way:
    """How router, rigs and consumer find each other."""

    router: list[str]
    rigs: list[str]
    consumer: ZenohSettings


def _plain() -> _Way:
    port = free_port()
    return _Way(["--port", str(port)], [], ZenohSettings(connect=f"tcp/127.0.0.1:{port}"))


def _tls(stack: ExitStack) -> _Way:
    keys, endpoint = stack.enter_context(TemporaryDirectory(prefix="velod-fleet-")), f"tls/127.0.0.1:{free_port()}"
    make_keys(keys)
    guard = ["--keys", keys]
    consumer = ZenohSettings(connect=endpoint, keys=keys, role="consumer")
    return _Way(["--port", str(free_port()), "--listen", endpoint, *guard], guard, consumer)


def _measure(listener: Listener, rigs: int, hz: float, seconds: float, router: int, groups: list[int]) -> Fleet:
    _receive(listener, _WARM_UP_S)
    lost_before, overflowed_before = _losses(listener)
    before = [sum(map(cpu_s, pids)) for pids in ([router], groups, [os.getpid()])]
    start_s = time.monotonic()
    latency_ms, heard = _receive(listener, seconds)
    elapsed_s = time.monotonic() - start_s
    lost, overflowed = _losses(listener)
    after = [sum(map(cpu_s, pids)) for pids in ([router], groups, [os.getpid()])]
    of_router, of_rigs, of_consumer = ((b - a) / elapsed_s for a, b in zip(before, after, strict=True))
    p50, p99 = np.percentile(latency_ms, (50, 99)) if latency_ms else (np.nan, np.nan)
    return Fleet(
        rigs=rigs,
        hz=hz,
        seconds=elapsed_s,
        rate_hz=len(latency_ms) / elapsed_s,
        silent=rigs - len(heard),
        lost=lost - lost_before,
        overflowed=overflowed - overflowed_before,
        latency_p50_ms=float(p50),
        latency_p99_ms=float(p99),
        router_cores=of_router,
        rigs_cores=of_rigs,
        consumer_cores=of_consumer,
        router_mib=resident_mib(router),
    )


def _losses(listener: Listener) -> tuple[int, int]:
    """Velocities that are missing, and those that its queues had no room for."""
    counters = listener.counters
    return counters.get("gap.velocity", 0), sum(
        n for name, n in counters.items() if name.startswith("inbox.overflow")
    )


def _receive(listener: Listener, seconds: float) -> tuple[list[float], set[str]]:
    """Latency of each velocity, ms, and the keys on which they came."""
    latency_ms: list[float] = []
    heard: set[str] = set()
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0.0:
        if (received := listener.receive(left_s)) is not None:
            latency_ms.append((received.t_received_ns - received.envelope.t_pub_ns) * 1e-6)
            heard.add(received.key)
    return latency_ms, heard


def _start(stack: ExitStack, module: list[str]) -> subprocess.Popen[str]:
    """A process that ends when its stdin does, or on SIGTERM."""
    pipe = subprocess.PIPE
    command = [sys.executable, "-P", "-m", *module]
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)

    def end() -> None:
        process.send_signal(signal.SIGTERM)
        try:
            process.communicate(timeout=START_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()

    stack.callback(end)
    return process
