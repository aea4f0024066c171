"""What each fault costs: ``python -m tests.system.faults [NAME...]``, as root, prints it as a table.

Sensor, compute and consumers are hosts of their own; everything runs twice where it can (two workers of flow and
depth, an optimizer that stands by). A fault begins two seconds after the first velocities.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tests import slanted_scene
from tests.system.hosts import Network, why_not
from tests.system.rig import Rig, Seen, pid_of
from velod.config import DepthSettings, FlowSettings, OptimizerSettings, Settings, ZenohSettings

SECONDS = 14.0
ROUTED = Path(__file__).parents[2] / "deploy" / "zenoh" / "behind-a-router.json5"
ROUTER_PORT = 7447
FRESH_MS = 200.0
"""What a client hands out is younger, by default."""

Span = tuple[int, int]
"""Host times at which a fault began and ended, ns."""


@dataclass(frozen=True, slots=True)
class Fault:
    """``harm`` does it, and returns when; ``prepare`` is called before anything runs."""

    name: str
    harm: Callable[[Rig], Span]
    prepare: Callable[[Rig], None] = lambda rig: None


@dataclass(frozen=True, slots=True)
class Cost:
    """What a consumer saw of a fault."""

    gap_s: float  # longest time between two valid velocities handed out
    back_s: float  # from the end of the fault to the next valid one
    lost: int  # ticks never handed out
    oldest_ms: float  # largest true age of a valid one when it was handed out, but for the least latency
    p99_ms: float  # of the way from publication to arrival

    @staticmethod
    def of(seen: Seen, span: Span) -> Cost:
        """By the one clock that all hosts of a test share."""
        valid = seen.valid()
        after_ns = min((row["t_ns"] for row in valid if row["t_ns"] > span[1]), default=0)
        return Cost(
            gap_s=seen.longest_gap_s(),
            back_s=(after_ns - span[1]) * 1e-9 if after_ns else float("inf"),
            lost=seen.lost(),
            oldest_ms=seen.oldest_ms(),
            p99_ms=float(np.percentile(seen.travel_ms(), 99)),
        )


def _now() -> int:
    return time.time_ns()


def kill(worker: str) -> Fault:
    """kill -9 of one worker."""

    def harm(rig: Rig) -> Span:
        os.kill(pid_of(worker, rig.compute), signal.SIGKILL)
        return _now(), _now()

    return Fault(f"kill -9 {worker}", harm)


def stop(worker: str, seconds: float = 3.0) -> Fault:
    """SIGSTOP of one worker, and SIGCONT."""

    def harm(rig: Rig) -> Span:
        return _stopped(pid_of(worker, rig.compute), seconds)

    return Fault(f"SIGSTOP {worker}, {seconds:g} s", harm)


def _stopped(pid: int, seconds: float) -> Span:
    os.kill(pid, signal.SIGSTOP)
    began_ns = _now()
    time.sleep(seconds)
    os.kill(pid, signal.SIGCONT)
    return began_ns, _now()


def _kill_supervisor(rig: Rig) -> Span:
    """Its workers go on; what systemd does is done here: start it again, which ends the fault."""
    assert rig.service is not None
    span = _now(), _now()
    rig.service.kill()
    rig.service.wait()
    rig.start_service(spare=False)
    return span


def _stop_supervisor(rig: Rig) -> Span:
    assert rig.service is not None
    return _stopped(rig.service.pid, 3.0)


def _stop_driver(rig: Rig) -> Span:
    return _stopped(pid_of("velod.runtime.player", rig.network["sensor"]), 3.0)


def _stop_consumer(rig: Rig) -> Span:
    return _stopped(pid_of(str(rig.directory / "consumer.jsonl"), rig.network["consumer"]), 10.0)


def _kill_consumer(rig: Rig) -> Span:
    os.kill(pid_of(str(rig.directory / "consumer.jsonl"), rig.network["consumer"]), signal.SIGKILL)
    return _now(), _now()


def unplug(host: str, seconds: float = 5.0) -> Fault:
    """The cable of one host is pulled out, and put back."""
    return Fault(
        f"link of the {host} down, {seconds:g} s",
        lambda rig: _for_a_while(lambda on: rig.network[host].plug(connected=not on), seconds),
    )


def swallow(host: str, seconds: float = 5.0) -> Fault:
    """All that one host sends and is sent is swallowed, without a word."""
    return Fault(
        f"black hole around the {host}, {seconds:g} s",
        lambda rig: _for_a_while(lambda on: rig.network[host].black_hole(swallows=on), seconds),
    )


def _for_a_while(harm: Callable[[bool], None], seconds: float) -> Span:
    harm(True)
    began_ns = _now()
    time.sleep(seconds)
    harm(False)
    return began_ns, _now()


def _poor(rig: Rig) -> None:
    rig.network["consumer"].shape(delay_ms=5.0, loss=0.01, mbit=100.0)


def _nothing(rig: Rig) -> Span:
    return _now(), _now()


def _behind_a_router(rig: Rig) -> None:
    """Every process is a client of one router, or connects to nothing but it."""
    at = f"{rig.compute.address}:{ROUTER_PORT}"
    config = rig.directory / "routed.json5"
    config.write_text(ROUTED.read_text().replace(f"127.0.0.1:{ROUTER_PORT}", at))
    rig.settings = replace(rig.settings, zenoh=ZenohSettings(config=str(config), insecure=True))
    rig.entrance = f"tcp/{at}"
    rig.start_router(rig.entrance)


def _restart_router(rig: Rig) -> Span:
    began_ns = _now()
    rig.kill_router()
    rig.start_router(rig.entrance)
    return began_ns, _now()


FAULTS: tuple[Fault, ...] = (
    Fault("none", _nothing),
    *(kill(worker) for worker in ("ingest-0", "flow-0", "depth-0", "optimizer-0")),
    Fault("kill -9 supervisor, started again", _kill_supervisor),
    Fault("kill -9 consumer", _kill_consumer),
    *(stop(worker) for worker in ("ingest-0", "flow-0", "depth-0", "optimizer-0")),
    Fault("SIGSTOP supervisor, 3 s", _stop_supervisor),
    Fault("SIGSTOP driver, 3 s", _stop_driver),
    Fault("SIGSTOP consumer, 10 s", _stop_consumer),
    Fault("router killed and started again", _restart_router, _behind_a_router),
    unplug("consumer"),
    unplug("sensor"),
    swallow("consumer"),
    swallow("sensor"),
    Fault("1 % loss, 5 ms, 100 Mbit to the consumer", _nothing, _poor),
)


def run(fault: Fault, directory: Path) -> tuple[Cost, Cost]:
    """What the consumer saw, and another one on a host of its own that nothing happens to."""
    recording = slanted_scene.write(directory / "slanted.h5", SECONDS)
    settings = replace(
        Settings(),
        flow=FlowSettings(workers=2),
        depth=DepthSettings(workers=2),
        optimizer=OptimizerSettings(workers=2),
    )
    with Network("sensor", "compute", "consumer", "bystander") as network:
        rig = Rig(network, recording, directory, settings)
        fault.prepare(rig)
        rig.start_service()
        consumers = {name: rig.start_consumer(name, name) for name in ("consumer", "bystander")}
        player = rig.start_player("sensor")
        rig.wait_for_velocities(150, "bystander")
        span = fault.harm(rig)
        player.wait(60.0)
        seen = {name: rig.seen(process, name) for name, process in consumers.items()}
    return Cost.of(seen["consumer"], span), Cost.of(seen["bystander"], span)


HEADER = (
    "| fault | gap, s | back after, s | lost | oldest, ms | p99 of the way, ms | bystander: gap, s | lost |\n"
    "|---|---|---|---|---|---|---|---|"
)


def row(name: str, consumer: Cost, bystander: Cost) -> str:
    """A line of the table."""
    c = consumer
    return (
        f"| {name} | {c.gap_s:.3f} | {c.back_s:.3f} | {c.lost} | {c.oldest_ms:.0f} | {c.p99_ms:.1f} "
        f"| {bystander.gap_s:.3f} | {bystander.lost} |"
    )


def main(wanted: Sequence[str]) -> int:
    """Print the table, or the rows whose names contain one of ``wanted``."""
    if reason := why_not():
        print(f"no table: {reason}", file=sys.stderr)
        return 1
    chosen = [fault for fault in FAULTS if not wanted or any(part in fault.name for part in wanted)]
    if not chosen:
        print(f"no fault of that name; faults: {'; '.join(fault.name for fault in FAULTS)}", file=sys.stderr)
        return 2
    print(HEADER, flush=True)
    for fault in chosen:
        with tempfile.TemporaryDirectory() as directory:
            print(row(fault.name, *run(fault, Path(directory))), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
