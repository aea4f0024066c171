"""``velod prove soak``: a velod at work for long, its workers killed and stopped at random; memory, files, latency.

All is as a user has it: `velod run`, a driver and a consumer, both over TLS. Workers are hit by kill -9 or SIGSTOP:
those of all four kinds in the first third, flow and depth alone in the second, so that the memory of the others can
be followed (a process that was replaced says nothing of leaks), and none in the last, in which nothing may grow. What
each death costs those who live on is told apart, shared memory included: Zenoh keeps that of a peer that died mapped,
64 MiB of it until velod empties it (``velod.runtime.pools``), and 1.3 MiB and two files for ever.
"""

from __future__ import annotations

import math
import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from velod.prove.besieged import Besieged
from velod.prove.processes import held_mib, open_files

SAMPLE_S = 1.0
STOPPED_S = 3.0
WARM_UP_S = 10.0
"""Of a process, before its memory is looked at."""
SETTLED_S = 60.0
"""A worker that was started anew fills its buffers for so long."""
LONG_S = 1500.0
"""Only a run so long can tell a slope of 1 MiB an hour from the noise of an allocator."""
MAX_SLOPE_MIB_H = 1.0
MAX_GROWTH_MIB = 4.0
"""In the last third of a shorter run."""
MAX_DEATH_MIB, MAX_DEATH_FILES = 8.0, 3.0
"""Of every other process, for each worker that was killed. Measured: 1 to 4 MiB, 1 or 2 files."""
MAX_DRIFT, MAX_DRIFT_SHORT = 1.5, 3.0
"""Median latency of the last third over that of the middle one; of a shorter run, which others may disturb."""
MAX_GAP_S = 2 * STOPPED_S
"""Without a velocity: a process was stopped for STOPPED_S, or one that died had no spare and took as long to load."""
ON_ITS_WAY_S = 0.1
"""A gap begins with the last velocity before it, up to so long before the fault that made it."""
_ANY, _STATELESS = ("ingest-0", "flow-0", "depth-0", "optimizer-0"), ("flow-0", "depth-0")


@dataclass(slots=True)
class Series:
    """What one process held, second by second; it begins anew where the process does."""

    pid: int
    t_s: list[float] = field(default_factory=list)
    mib: list[float] = field(default_factory=list)
    files: list[int] = field(default_factory=list)

    def between(self, start_s: float, end_s: float) -> tuple[list[float], list[float], list[int]]:
        """Times, memory and files of a part of the run."""
        part = slice(int(np.searchsorted(self.t_s, start_s)), int(np.searchsorted(self.t_s, end_s)))
        return self.t_s[part], self.mib[part], self.files[part]


@dataclass(frozen=True, slots=True)
class Lasting:
    """One process that lived through the last two thirds."""

    worker: str
    seconds: float
    mib: float
    files: int
    slope_mib_h: float  # of a line through the last third
    growth_mib: float  # in the last third, by that line
    new_files: int  # in the last third
    death_mib: float  # more in the first two thirds, for each worker killed meanwhile; NaN: none was
    death_files: float


@dataclass(frozen=True, slots=True)
class Soak:
    """What came of a run."""

    seconds: float
    faults: dict[str, int]  # "kill flow-0": times
    served: int  # valid velocities at the consumer
    longest_gap_s: float
    gap_begun_s: float  # since the start
    gap_after: str  # the last fault before it, and when
    gap_heard: str  # states and reasons of invalid velocities in it, and alarms of all processes
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
                found.append(f"{p.worker} grew by {p.growth_mib:.1f} MiB in the last third")
            if p.new_files > 0:
                found.append(f"{p.worker} has {p.new_files} more files open")
            if p.death_mib > MAX_DEATH_MIB or p.death_files > MAX_DEATH_FILES:
                found.append(f"{p.worker} keeps {p.death_mib:.1f} MiB, {p.death_files:.1f} files of each dead worker")
        drift = MAX_DRIFT if self.seconds >= LONG_S else MAX_DRIFT_SHORT
        if self.latency_last_ms > drift * self.latency_middle_ms:
            found.append(f"latency rose from {self.latency_middle_ms:.1f} to {self.latency_last_ms:.1f} ms")
        if not self.served:
            found.append("no velocity came")
        elif self.longest_gap_s > MAX_GAP_S:
            found.append(f"no velocity for {self.gap()}")
        return found

    def gap(self) -> str:
        """The longest one in words."""
        return (
            f"{self.longest_gap_s:.2f} s from {self.gap_begun_s:.1f} s on, after {self.gap_after}; "
            f"heard meanwhile: {self.gap_heard}"
        )


def soak(recording: Path, seconds: float, fault_every_s: float, seed: int, on_fault: Callable[[str], None]) -> Soak:
    """Play ``recording`` again and again for so long. The same seed hits the same workers. Raises SiegeError."""
    chance = random.Random(seed)
    series: dict[str, Series] = {}
    latency_ms: list[tuple[float, float]] = []
    hits: list[tuple[float, str]] = []
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
            if time.monotonic() >= next_fault_s and elapsed_s < 2 * seconds / 3 - WARM_UP_S:
                hit_s = time.monotonic() - start_s
                hits.append((hit_s, _hit(target, chance, _ANY if elapsed_s < seconds / 3 else _STATELESS)))
                on_fault(f"{hit_s:.1f} s: {hits[-1][1]}")
                next_fault_s = time.monotonic() + fault_every_s * chance.uniform(0.7, 1.3)
        gap = target.longest_gap()
        gap_begun_s = gap.begun_s - start_s
        killed_s = [hit_s for hit_s, fault in hits if fault.startswith("kill")]
        return Soak(
            elapsed_s,
            dict(Counter(fault for _, fault in hits)),
            target.n_heard() - served,
            gap.seconds,
            gap_begun_s,
            _last_before(gap_begun_s, hits),
            str(gap),
            _median(latency_ms, seconds / 3, 2 * seconds / 3),
            _median(latency_ms, 2 * seconds / 3, seconds),
            [_judge(w, s, seconds, killed_s) for w, s in sorted(series.items()) if _lasted(s, seconds)],
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


def _last_before(t_s: float, hits: list[tuple[float, str]]) -> str:
    """The last fault before the gap that began at ``t_s``, which a velocity on its way may have put off."""
    before = [f"{fault} at {hit_s:.1f} s" for hit_s, fault in hits if hit_s < t_s + ON_ITS_WAY_S]
    return before[-1] if before else "no fault"


def _sample(target: Besieged, series: dict[str, Series], t_s: float) -> None:
    for worker, pid in {**target.process_ids(), "driver": target.driver_pid}.items():
        if worker not in series or series[worker].pid != pid:
            series[worker] = Series(pid)
        if (mib := held_mib(pid)) > 0.0:
            series[worker].t_s.append(t_s)
            series[worker].mib.append(mib)
            series[worker].files.append(open_files(pid))


def _lasted(series: Series, seconds: float) -> bool:
    """Whether a process was there long enough before the last third, and to the end."""
    begun_s, ended_s = (series.t_s[0], series.t_s[-1]) if series.t_s else (math.inf, 0.0)
    return begun_s < max(2 * SAMPLE_S, 2 * seconds / 3 - SETTLED_S) and ended_s > 0.9 * seconds


def _judge(worker: str, series: Series, seconds: float, killed_s: list[float]) -> Lasting:
    quiet_s = 2 * seconds / 3
    begun_s = series.t_s[0] + WARM_UP_S
    t_s, mib, files = series.between(quiet_s, math.inf)
    _, mib_before, files_before = series.between(begun_s, quiet_s)
    slope_mib_s = float(np.polyfit(t_s, mib, 1)[0]) if len(t_s) > 2 else math.nan
    half = len(files) // 2
    deaths = sum(t >= begun_s for t in killed_s) or math.nan
    return Lasting(
        worker=worker,
        seconds=series.t_s[-1] - series.t_s[0],
        mib=series.mib[-1],
        files=series.files[-1],
        slope_mib_h=slope_mib_s * 3600.0,
        growth_mib=slope_mib_s * (t_s[-1] - t_s[0]) if t_s else math.nan,
        new_files=int(np.median(files[half:]) - np.median(files[:half])) if half else 0,
        death_mib=(mib_before[-1] - mib_before[0]) / deaths if mib_before else math.nan,
        death_files=(files_before[-1] - files_before[0]) / deaths if files_before else math.nan,
    )


def _median(samples: list[tuple[float, float]], start_s: float, end_s: float) -> float:
    chosen = [value for t_s, value in samples if start_s <= t_s < end_s]
    return float(np.median(chosen)) if chosen else math.nan
