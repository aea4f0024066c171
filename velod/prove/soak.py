"""``velod prove soak``: a velod at work for long, its workers killed and stopped at random; memory, files, latency.

All is as a user has it: `velod run`, a driver and a consumer, both over TLS. Workers are hit by kill -9 or SIGSTOP:
those of all four kinds in the first third, later flow and depth alone, so that the memory of the others can be
followed. (A process that was replaced says nothing of leaks.)
"""

from __future__ import annotations

import math
import os
import random
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from velod.prove.besieged import Besieged
from velod.prove.processes import open_files, resident_mib

SAMPLE_S = 1.0
STOPPED_S = 3.0
LONG_S = 1500.0
"""Only a run so long can tell a slope of 1 MiB an hour from the noise of an allocator."""
MAX_SLOPE_MIB_H = 1.0
MAX_GROWTH_MIB = 12.0
"""In a short run, over its second half."""
MAX_NEW_FILES = 3
"""The supervisor has a pipe more or less while a spare is being made."""
MAX_DRIFT = 1.5
"""Median latency of the last third over that of the middle one."""
_ANY, _STATELESS = ("ingest-0", "flow-0", "depth-0", "optimizer-0"), ("flow-0", "depth-0")


@dataclass(slots=True)
class Series:
    """What one process held, second by second; it begins anew where the process does."""

    pid: int
    t_s: list[float] = field(default_factory=list)
    mib: list[float] = field(default_factory=list)
    files: list[int] = field(default_factory=list)

    def growth_mib(self) -> float:
        """From the third quarter to the last."""
        n = len(self.mib)
        return float(np.median(self.mib[3 * n // 4 :]) - np.median(self.mib[n // 2 : 3 * n // 4])) if n >= 8 else 0.0

    def slope_mib_h(self) -> float:
        """Of a line through the last two thirds; NaN without samples."""
        start = len(self.mib) // 3
        if len(self.mib) - start < 8:
            return math.nan
        return float(np.polyfit(self.t_s[start:], self.mib[start:], 1)[0] * 3600.0)

    def new_files(self) -> int:
        """Between the middle of the run and its end."""
        n = len(self.files)
        return int(np.median(self.files[3 * n // 4 :]) - np.median(self.files[n // 2 : 3 * n // 4])) if n >= 8 else 0


@dataclass(frozen=True, slots=True)
class Lasting:
    """One process that lived through the last two thirds."""

    worker: str
    seconds: float
    mib: float
    growth_mib: float
    slope_mib_h: float
    files: int
    new_files: int


@dataclass(frozen=True, slots=True)
class Soak:
    """What came of a run."""

    seconds: float
    faults: dict[str, int]  # "kill flow-0": times
    served: int  # valid velocities at the consumer
    longest_gap_s: float
    latency_middle_ms: float  # batch closed to velocity out, median of the middle third
    latency_last_ms: float
    processes: list[Lasting]

    def failures(self) -> list[str]:
        """What is not as claimed."""
        found = []
        for p in self.processes:
            if self.seconds >= LONG_S and p.slope_mib_h > MAX_SLOPE_MIB_H:
                found.append(f"{p.worker} grows by {p.slope_mib_h:.1f} MiB/h")
            if p.growth_mib > MAX_GROWTH_MIB:
                found.append(f"{p.worker} grew by {p.growth_mib:.1f} MiB in a quarter of the run")
            if p.new_files > MAX_NEW_FILES:
                found.append(f"{p.worker} has {p.new_files} more files open")
        if self.latency_last_ms > MAX_DRIFT * self.latency_middle_ms:
            found.append(f"latency rose from {self.latency_middle_ms:.1f} to {self.latency_last_ms:.1f} ms")
        if not self.served:
            found.append("no velocity came")
        return found


def soak(recording: Path, seconds: float, fault_every_s: float, seed: int, on_fault: Callable[[str], None]) -> Soak:
    """Play ``recording`` again and again for so long. The same seed hits the same workers. Raises SiegeError."""
    chance = random.Random(seed)
    series: dict[str, Series] = {}
    latency_ms: list[tuple[float, float]] = []
    faults: dict[str, int] = {}
    with Besieged(recording, speed=1.0) as target:
        start_s = time.monotonic()
        next_fault_s = start_s + fault_every_s
        seen, served = -1, target.n_heard()
        while (elapsed_s := time.monotonic() - start_s) < seconds:
            time.sleep(SAMPLE_S)
            _sample(target, series, elapsed_s)
            health = target.health_of("optimizer-0")
            if health.seq != seen and "end_to_end_p50" in health.latency_ms:
                seen = health.seq
                latency_ms.append((elapsed_s, health.latency_ms["end_to_end_p50"]))
            if time.monotonic() >= next_fault_s and elapsed_s < seconds - fault_every_s:
                fault = _hit(target, chance, _ANY if elapsed_s < seconds / 3 else _STATELESS)
                faults[fault] = faults.get(fault, 0) + 1
                on_fault(f"{elapsed_s:.0f} s: {fault}")
                next_fault_s = time.monotonic() + fault_every_s * chance.uniform(0.7, 1.3)
        return Soak(
            elapsed_s,
            faults,
            target.n_heard() - served,
            target.longest_gap_s(),
            _median(latency_ms, seconds / 3, 2 * seconds / 3),
            _median(latency_ms, 2 * seconds / 3, seconds),
            _lasting(series, seconds),
        )


def _hit(target: Besieged, chance: random.Random, workers: tuple[str, ...]) -> str:
    """One fault, over when this returns but for what follows from it."""
    worker = chance.choice(workers)
    pid = target.process_ids()[worker]
    try:
        if chance.random() < 0.5:
            os.kill(pid, signal.SIGKILL)
            return f"kill {worker}"
        os.kill(pid, signal.SIGSTOP)
        time.sleep(chance.uniform(0.1, STOPPED_S))
        os.kill(pid, signal.SIGCONT)
    except ProcessLookupError:
        return f"{worker} was gone"  # replaced a moment ago, and its health has not been heard yet
    return f"stop {worker}"


def _sample(target: Besieged, series: dict[str, Series], t_s: float) -> None:
    for worker, pid in {**target.process_ids(), "driver": target.driver_pid}.items():
        if worker not in series or series[worker].pid != pid:
            series[worker] = Series(pid)
        if (mib := resident_mib(pid)) > 0.0:
            series[worker].t_s.append(t_s)
            series[worker].mib.append(mib)
            series[worker].files.append(open_files(pid))


def _lasting(series: dict[str, Series], seconds: float) -> list[Lasting]:
    return [
        Lasting(worker, s.t_s[-1] - s.t_s[0], s.mib[-1], s.growth_mib(), s.slope_mib_h(), s.files[-1], s.new_files())
        for worker, s in sorted(series.items())
        if s.t_s and s.t_s[-1] - s.t_s[0] > 0.6 * seconds
    ]


def _median(samples: list[tuple[float, float]], start_s: float, end_s: float) -> float:
    chosen = [value for t_s, value in samples if start_s <= t_s < end_s]
    return float(np.median(chosen)) if chosen else math.nan
