"""How long each part takes, on one core, beside a peer that computes the same in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np

Run = Callable[[], Any]


@dataclass(frozen=True, slots=True)
class Size:
    """How much is computed."""

    repeats: int = 200  # of each case
    peer_repeats: int = 10  # of slow peers
    seconds: float = 0.5  # of the event stream
    dataflow_seconds: float = 2.0  # of the one through all processes
    events: int = 45_000  # of each camera in a batch
    flows: int = 500  # of a batch of the solver's
    window: int = 75  # batches in its window


@dataclass(frozen=True, slots=True)
class Case:
    """One thing to measure. ``per``: of how many units one run of ``run`` is made."""

    name: str
    run: Run
    per: int = 1
    peer: str | None = None
    run_peer: Run | None = None
    peer_per: int = 1
    disagreement: Callable[[], float] | None = None
    slow: bool = False  # the peer is
    events: int = 0  # that one run takes in
    clocked: bool = False  # ``run`` returns its own time, in ns


@dataclass(frozen=True, slots=True)
class Result:
    """Median time of one unit, and the peer's; ``n`` is how often it was measured."""

    name: str
    median_us: float
    n: int
    _: KW_ONLY
    peer: str | None = None
    peer_median_us: float | None = None
    mev_s: float | None = None  # million events a second, where a unit takes many in
    p99_us: float | None = None
    more: Mapping[str, float] = field(default_factory=dict)  # further fields, by name and unit

    def row(self) -> dict[str, Any]:
        """The fields of ``velod bench --json``; ratio = peer / ours."""
        ratio = None if self.peer_median_us is None else self.peer_median_us / self.median_us
        row = {
            "name": self.name,
            "median_us": self.median_us,
            "peer": self.peer,
            "peer_median_us": self.peer_median_us,
            "ratio": ratio,
            "n": self.n,
        }
        more = {"mev_s": self.mev_s, "p99_us": self.p99_us}
        return row | {name: value for name, value in more.items() if value is not None} | dict(self.more)


def measure(case: Case, size: Size) -> Result:
    """Run a case, and its peer, after one run of each that does not count (compiling, caches)."""
    repeats = size.repeats if case.events == 0 else max(1, size.peer_repeats // 3)
    ours_us = _median_us(case.run, repeats, case.clocked) / case.per
    peer_us = None
    if case.run_peer is not None:
        peer_us = _median_us(case.run_peer, size.peer_repeats if case.slow else size.repeats) / case.peer_per
    mev_s = case.events / (ours_us * case.per) if case.events else None
    return Result(case.name, ours_us, repeats, peer=case.peer, peer_median_us=peer_us, mev_s=mev_s)


def _median_us(run: Run, repeats: int, clocked: bool = False) -> float:
    run()
    times_ns = []
    for _ in range(repeats):
        start_ns = time.perf_counter_ns()
        own_ns = run()
        times_ns.append(own_ns if clocked else time.perf_counter_ns() - start_ns)
    return float(np.median(times_ns)) / 1e3
