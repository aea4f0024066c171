"""``velod prove soak``: a velod at work for long, its workers killed and stopped at random; memory, files, latency.

All is as a user has it: `velod run`, a driver and a consumer, both over TLS. Workers are hit by kill -9 or SIGSTOP:
those of all four kinds in the first third, flow and depth alone in the second, so that the memory of the others can
be followed (a process that was replaced says nothing of leaks), and none in the last, in which nothing may grow. What
each death costs those who live on is told apart (``holding``), and so is shared memory, of which the host has one
however many processes map it: Zenoh keeps that of a peer that died, 64 MiB of it until velod empties it
(``velod.runtime.pools``), and 1.3 MiB and two files for ever.
"""

from __future__ import annotations

import math
import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from velod.prove.besieged import Besieged
from velod.prove.holding import KILL, WARM_UP_S, Hit, Lasting, Series, judge
from velod.prove.processes import open_files, own_mib, shared_memory_mib
from velod.runtime.heap import KEPT

SAMPLE_S = 1.0
STOPPED_S = 3.0
LONG_S = 1500.0
"""Only a run so long can tell a slope of 1 MiB an hour from the noise of an allocator."""
MAX_SLOPE_MIB_H = 1.0
MAX_GROWTH_MIB = 4.0
"""In the last third of a shorter run."""
MAX_DEATH_MIB, MAX_DEATH_FILES = 8.0, 3.0
"""Of every other process, for each worker that was killed. Measured: 0 to 4 MiB, 1 or 2 files."""
MAX_SHARED_MIB, MAX_DEATH_SHARED_MIB = 16.0, 2.0
"""By so much may the host's shared memory grow, a quarter of a pool, and for each worker that was killed besides:
measured 1.3 MiB, which Zenoh keeps."""
MAX_DRIFT, MAX_DRIFT_SHORT = 1.5, 3.0
"""Median latency of the last third over that of the middle one; of a shorter run, which others may disturb."""
MAX_GAP_S = 2 * STOPPED_S
"""Without a velocity: a process was stopped for STOPPED_S, or one that died had no spare and took as long to load."""
ON_ITS_WAY_S = 0.1
"""A gap begins with the last velocity before it, up to so long before the fault that made it."""
_ANY, _STATELESS = ("ingest-0", "flow-0", "depth-0", "optimizer-0"), ("flow-0", "depth-0")


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
    shared_mib: float  # the host's, of all processes, each piece once
    shared_growth_mib: float  # since the first faults
    highest_load: float  # of the machine, over a minute: above its cores, others took what velod needed
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
            mib, files = p.death_mib or 0.0, p.death_files or 0.0
            if mib > MAX_DEATH_MIB or files > MAX_DEATH_FILES:
                found.append(f"{p.worker} keeps {mib:.1f} MiB, {files:.1f} files of each dead worker")
        deaths = sum(n for fault, n in self.faults.items() if fault.startswith(KILL))
        if self.shared_growth_mib > MAX_SHARED_MIB + deaths * MAX_DEATH_SHARED_MIB:
            found.append(f"shared memory grew by {self.shared_growth_mib:.0f} MiB over {deaths} deaths")
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
    shared_mib: list[float] = []
    load: list[float] = []
    hits: list[Hit] = []
    with Besieged(recording, speed=1.0) as target:
        start_s = time.monotonic()
        next_fault_s = start_s + fault_every_s
        seen, served = -1, target.n_heard()
        while (elapsed_s := time.monotonic() - start_s) < seconds:
            time.sleep(SAMPLE_S)
            _sample(target, series, time.monotonic() - start_s)
            shared_mib.append(shared_memory_mib(target.process_ids().values()))
            load.append(os.getloadavg()[0])
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
            shared_mib[-1],
            shared_mib[-1] - shared_mib[0],
            max(load),
            [judge(w, s, seconds, hits) for w, s in sorted(series.items()) if s.lasted(seconds)],
        )


def _hit(target: Besieged, chance: random.Random, workers: tuple[str, ...]) -> str:
    """One fault, over when this returns but for what follows from it."""
    worker = chance.choice(workers)
    pid = target.process_ids()[worker]
    try:
        if chance.random() < 0.5:
            os.kill(pid, signal.SIGKILL)
            return f"{KILL}{worker}"
        os.kill(pid, signal.SIGSTOP)
        time.sleep(chance.uniform(0.1, STOPPED_S))
        os.kill(pid, signal.SIGCONT)
    except ProcessLookupError:
        return f"{worker} was gone"  # replaced a moment ago, and its health has not been heard yet
    return f"stop {worker}"


def _last_before(t_s: float, hits: list[Hit]) -> str:
    """The last fault before the gap that began at ``t_s``, which a velocity on its way may have put off."""
    before = [f"{fault} at {hit_s:.1f} s" for hit_s, fault in hits if hit_s < t_s + ON_ITS_WAY_S]
    return before[-1] if before else "no fault"


def _sample(target: Besieged, series: dict[str, Series], t_s: float) -> None:
    for worker, pid in {**target.process_ids(), "driver": target.driver_pid}.items():
        if worker not in series or series[worker].pid != pid:
            series[worker] = Series(pid)
        if (mib := own_mib(pid)) > 0.0:
            series[worker].t_s.append(t_s)
            series[worker].mib.append(mib)
            series[worker].used_mib.append(mib - target.gauge_of(pid, KEPT))
            series[worker].files.append(open_files(pid))


def _median(samples: list[tuple[float, float]], start_s: float, end_s: float) -> float:
    chosen = [value for t_s, value in samples if start_s <= t_s < end_s]
    return float(np.median(chosen)) if chosen else math.nan
