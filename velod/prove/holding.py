"""What processes hold while others beside them die: memory, shared memory and files, and what of it is for good.

Three things look like a leak and are none. What a process takes to catch up, after it or another was stopped or
died, is freed, but stays its own: the C library keeps it for what comes next, and says how much that is. A pool of
shared memory is the host's once, however many processes map it. And a process fills its buffers in its first minute.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

WARM_UP_S = 10.0
"""Of a process, before its memory is looked at."""
SETTLED_S = 60.0
"""A worker that was started anew fills its buffers for so long."""
KILL = "kill "
"""Begins the name of a fault that is a death."""
_LOOKS = 3
"""Of which the median is taken: what is under way comes and goes."""

Hit = tuple[float, str]
"""When, since the start, s; and what: ``kill flow-0``."""


@dataclass(slots=True)
class Series:
    """What one process held, second by second; it begins anew where the process does."""

    pid: int
    t_s: list[float] = field(default_factory=list)
    mib: list[float] = field(default_factory=list)  # of its own
    used_mib: list[float] = field(default_factory=list)  # of that: without what is free for what comes next
    files: list[int] = field(default_factory=list)

    def lasted(self, seconds: float) -> bool:
        """Whether the process was there for long enough before the last third of a run, and to its end."""
        begun_s, ended_s = (self.t_s[0], self.t_s[-1]) if self.t_s else (math.inf, 0.0)
        return begun_s < max(2.0, 2 * seconds / 3 - SETTLED_S) and ended_s > 0.9 * seconds


@dataclass(frozen=True, slots=True)
class Lasting:
    """One process that lived through the last two thirds of a run."""

    worker: str
    seconds: float
    mib: float
    files: int
    slope_mib_h: float  # of a line through the last third
    growth_mib: float  # in the last third: of what is resident, by that line, or of what is used, whichever is less
    new_files: int  # in the last third
    death_mib: float | None  # kept of each worker that died (``kept_of_deaths``); None: too few did
    death_files: float | None


def judge(worker: str, series: Series, seconds: float, hits: Sequence[Hit]) -> Lasting:
    """What a process kept, in a run in whose last third nothing happens."""
    quiet_s = 2 * seconds / 3
    quiet = slice(int(np.searchsorted(series.t_s, quiet_s)), None)
    t_s, mib, files = series.t_s[quiet], series.mib[quiet], series.files[quiet]
    slope_mib_s = float(np.polyfit(t_s, mib, 1)[0]) if len(t_s) > 2 else math.nan
    used_growth_mib = 2.0 * _rise(series.used_mib[quiet])  # from the middle of one half to that of the other
    seen = [hit for hit in hits if hit[0] >= series.t_s[0] + WARM_UP_S]
    return Lasting(
        worker=worker,
        seconds=series.t_s[-1] - series.t_s[0],
        mib=series.mib[-1],
        files=series.files[-1],
        slope_mib_h=slope_mib_s * 3600.0,
        growth_mib=min(slope_mib_s * (t_s[-1] - t_s[0]), used_growth_mib) if t_s else math.nan,
        new_files=int(_rise(files)),
        death_mib=kept_of_deaths(series.t_s, series.used_mib, seen, quiet_s),
        death_files=kept_of_deaths(series.t_s, series.files, seen, quiet_s),
    )


def kept_of_deaths(t_s: Sequence[float], held: Sequence[float], hits: Iterable[Hit], end_s: float) -> float | None:
    """How much more is held for each death of another worker; None where no kind of worker died twice.

    A death's share is what was held just before the next fault, less what was just before the death: what faults of
    other kinds do is not its. Of each kind of worker it is the (lower) median, as a leak shows at every death, and of
    the kinds the largest.
    """
    kept: dict[str, list[float]] = {}
    for (hit_s, fault), (next_s, _) in pairwise([*hits, (end_s, "")]):
        if fault.startswith(KILL):
            kept.setdefault(fault, []).append(_before(next_s, t_s, held) - _before(hit_s, t_s, held))
    return max((sorted(k)[(len(k) - 1) // 2] for k in kept.values() if len(k) > 1), default=None)


def _rise(held: Sequence[float]) -> float:
    """How much more was held in the second half than in the first, by their medians."""
    half = len(held) // 2
    return float(np.median(held[half:]) - np.median(held[:half])) if half else 0.0


def _before(at_s: float, t_s: Sequence[float], held: Sequence[float]) -> float:
    """What was held just before a moment."""
    end = int(np.searchsorted(t_s, at_s, "right"))
    return float(np.median(held[max(0, end - _LOOKS) : max(1, end)]))
