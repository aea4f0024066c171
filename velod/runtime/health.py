"""One Health message per second from every process: what it did, what it lost, how long it took."""

from __future__ import annotations

import os
import socket
import time
from importlib.metadata import PackageNotFoundError, version

from velod.runtime.heap import heap_gauges
from velod.runtime.measure import LatencyRing
from velod.types import Health

PERIOD_S = 1.0


def velod_version() -> str:
    """The installed version; ``unknown`` where velod runs without being installed."""
    try:
        return version("velod")
    except PackageNotFoundError:
        return "unknown"


class HealthReporter:
    """Collects latencies of one process and turns its counters into a Health message once per period."""

    def __init__(self, stage: str, worker: str) -> None:
        self.latencies: dict[str, LatencyRing] = {}
        self._stage, self._worker = stage, worker
        self._host, self._version = socket.gethostname(), velod_version()
        self._start_s = self._last_s = time.monotonic()
        self._before: dict[str, int] = {}
        self._seq = 0

    def add_latency(self, name: str, ns: int) -> None:
        """One sample of the latency ``name``."""
        self.latencies.setdefault(name, LatencyRing()).add(ns)

    def due_in_s(self) -> float:
        """Time until the next report, 0 when it is due."""
        return max(0.0, self._last_s + PERIOD_S - time.monotonic())

    def report(
        self,
        t_ns: int,
        counters: dict[str, int],
        alarms: dict[str, str],
        role: str = "",
        gauges: dict[str, float] | None = None,
    ) -> Health:
        """Health of the period that ends now. ``t_ns``: newest sensor time seen, 0 for none."""
        now_s = time.monotonic()
        elapsed_s = max(now_s - self._last_s, 1e-3)
        rates = {
            name: (n - self._before.get(name, 0)) / elapsed_s
            for name, n in counters.items()
            if n != self._before.get(name, 0)
        }
        health = Health(
            seq=self._seq,
            t_ns=t_ns,
            stage=self._stage,
            worker=self._worker,
            pid=os.getpid(),
            host=self._host,
            version=self._version,
            uptime_s=now_s - self._start_s,
            counters=dict(counters),
            rates=rates,
            latency_ms=self._latency_ms(),
            alarms=alarms,
            role=role,
            gauges={**(gauges or {}), **heap_gauges()},
        )
        self._seq += 1
        self._last_s, self._before = now_s, dict(counters)
        return health

    def _latency_ms(self) -> dict[str, float]:
        """``<name>_p50`` and ``<name>_p99`` of the period."""
        out: dict[str, float] = {}
        for name, ring in self.latencies.items():
            if (percentiles := ring.percentiles()) is not None:
                out[f"{name}_p50"], out[f"{name}_p99"] = percentiles
            ring.clear()
        return out
