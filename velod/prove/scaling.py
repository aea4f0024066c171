"""``velod prove scaling``: throughput and latency against the number of flow workers, and what each stage costs.

One flow worker is made insufficient by an artificial load: it sleeps for so long on each batch. Sleeping needs no
core, so this shows how work is shared out and what that costs, on any machine; it does not show what more cores give.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from velod.client import Listener, Received
from velod.config import Settings, ZenohSettings
from velod.io import open_recording
from velod.prove.besieged import free_port
from velod.prove.processes import cpu_s
from velod.runtime.player import player_command
from velod.runtime.process import ChildProcess, stop_all
from velod.runtime.session import introducer_endpoint
from velod.runtime.stacked import Stacked
from velod.runtime.stages import STAGES, stage_of
from velod.runtime.supervisor import Supervisor
from velod.types import FlowBatch, Health, Velocity
from velod.wire.topics import FLOW, HEALTH, VELOCITY

START_S = 120.0
_POLL_S = 0.02
_LAST_WORDS_S = 1.0
_OTHERS = tuple(stage for stage in STAGES if stage != "flow")


class ScalingError(RuntimeError):
    """The processes did not come up, or the player failed; one line."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Of all workers of a stage."""

    cores: float  # CPU seconds per second
    mb_s: float  # published


@dataclass(frozen=True, slots=True)
class Scaling:
    """What came of a run with so many flow workers."""

    workers: int
    load_ms: float  # of each batch
    closed_hz: float  # batches that ingest closed
    flow_hz: float  # batches whose flow came
    dropped: int  # batches that waited for a flow worker too long, or did not fit into the queue
    shed: int  # batches that ingest did not make, because it was late
    latency_p50_ms: float  # batch closed to the first velocity that uses it
    latency_p99_ms: float
    velocities: int
    costs: dict[str, Cost] = field(default_factory=dict)  # by stage


def scaling(
    recording: Path, counts: list[int], load_ms: float, speed: float, say: Callable[[str], None]
) -> list[Scaling]:
    """Play ``recording`` once for each number of flow workers. Raises ScalingError."""
    rows = []
    for workers in counts:
        say(f"{workers} flow worker{'s' if workers > 1 else ''}")
        with _Service(recording, workers, load_ms) as service:
            rows.append(service.play(recording, speed))
    return rows


class _Service(Stacked):
    """A velod whose flow workers are slow. A context manager."""

    def __init__(self, recording: Path, workers: int, load_ms: float) -> None:
        self._workers, self._load_ms = workers, load_ms
        self._settings = Settings(zenoh=ZenohSettings(port=free_port()))
        self._calibration = open_recording(recording).calibration
        self._slow: list[ChildProcess] = []
        self._health: dict[str, Health] = {}
        self._latency_ms: list[float] = []
        self._newest_batch = -1
        self._n_flow = self._n_velocities = 0

    def _open(self, stack: ExitStack) -> None:
        endpoint = introducer_endpoint(self._settings.zenoh)
        self._supervisor = stack.enter_context(
            Supervisor(self._settings, self._calibration, _OTHERS, spare=False, on_line=_ignore)
        )
        stack.callback(lambda: stop_all(self._slow))
        for i in range(self._workers):
            command = [sys.executable, "-P", "-m", "velod.prove.slow_worker", endpoint, f"flow-{i}"]
            self._slow.append(ChildProcess([*command, f"{self._load_ms:g}"], _ignore))
        self._listener = stack.enter_context(
            Listener(self._settings.rig.name, (HEALTH, FLOW, VELOCITY), ZenohSettings(connect=endpoint))
        )
        self._wait_until_up()

    def play(self, recording: Path, speed: float) -> Scaling:
        """Play it once, beginning to end."""
        pids = self._supervisor.process_ids() | {f"flow-{i}": p.pid for i, p in enumerate(self._slow)}
        before_s = {worker: cpu_s(pid) for worker, pid in pids.items()}
        command = player_command(str(recording), self._settings.zenoh, self._settings.rig.name, speed)
        player = ChildProcess(command, _ignore)
        try:
            while player.exit_code() is None:
                self._step()
            if player.exit_code():
                raise ScalingError(f"the player failed: {player.why()}")
        finally:
            stop_all([player])
        used_s = {worker: cpu_s(pid) - before_s[worker] for worker, pid in pids.items()}
        self._supervisor.stop_workers()
        stop_all(self._slow)
        self._hear_last_words()
        return self._judge(used_s, open_recording(recording).duration_s / speed)

    def _wait_until_up(self) -> None:
        deadline_s, wanted = time.monotonic() + START_S, {f"flow-{i}" for i in range(self._workers)}
        while not (self._supervisor.is_up() and wanted <= {worker for _, worker in self._listener.alive()}):
            self._step()
            if time.monotonic() > deadline_s:
                raise ScalingError(f"the service is not up after {START_S:g} s")

    def _step(self) -> None:
        self._supervisor.step()
        end_s = time.monotonic() + _POLL_S
        while (left_s := end_s - time.monotonic()) > 0.0:
            if (received := self._listener.receive(left_s)) is not None:
                self._note(received)

    def _hear_last_words(self) -> None:
        while (received := self._listener.receive(_LAST_WORDS_S)) is not None:
            self._note(received)

    def _note(self, received: Received) -> None:
        envelope = received.envelope
        if isinstance(envelope.message, Health):
            self._health[envelope.message.worker] = envelope.message
        elif isinstance(envelope.message, FlowBatch):
            self._n_flow += 1
        elif isinstance(envelope.message, Velocity):
            self._n_velocities += 1
            if envelope.t_origin_ns and envelope.message.batch_seq != self._newest_batch:
                self._newest_batch = envelope.message.batch_seq
                self._latency_ms.append((envelope.t_pub_ns - envelope.t_origin_ns) * 1e-6)

    def _judge(self, used_s: dict[str, float], seconds: float) -> Scaling:
        counters = self._health["ingest-0"].counters
        p50, p99 = np.percentile(self._latency_ms, (50, 99)) if self._latency_ms else (np.nan, np.nan)
        return Scaling(
            workers=self._workers,
            load_ms=self._load_ms,
            closed_hz=counters["batches"] / seconds,
            flow_hz=self._n_flow / seconds,
            dropped=sum(counters.get(f"dispatch.{why}.flow", 0) for why in ("overflow", "stale")),
            shed=counters.get("shed.batches", 0),
            latency_p50_ms=float(p50),
            latency_p99_ms=float(p99),
            velocities=self._n_velocities,
            costs={stage: self._cost(stage, used_s, seconds) for stage in STAGES},
        )

    def _cost(self, stage: str, used_s: dict[str, float], seconds: float) -> Cost:
        workers = [worker for worker in used_s if stage_of(worker) == stage]
        published = sum(
            n
            for worker in workers
            if worker in self._health
            for name, n in self._health[worker].counters.items()
            if name.startswith("bytes.")
        )
        return Cost(sum(used_s[worker] for worker in workers) / seconds, published / seconds * 1e-6)


def _ignore(line: str) -> None:
    del line
