"""``velod bench``: how long each part takes, beside a peer."""

from __future__ import annotations

import sys

import cv2

from velod.cli_report import write_json
from velod.config import Settings
from velod.eval.bench import Result, Size, measure
from velod.eval.bench_cases import GROUPS, Packets, cases
from velod.eval.bench_input import RIG
from velod.runtime.offline import run_offline
from velod.runtime.warmup import fill_cache
from velod.types import Velocity


def bench(group: str, json: str | None, size: Size | None = None) -> int:
    """Measure one of GROUPS or ``all``; a table on stdout (on stderr where the JSON goes there)."""
    size = size or Size()
    # One core for everyone: the peers' libraries would take all.
    cv2.setNumThreads(1)
    fill_cache(Settings(), RIG)
    table = sys.stderr if json == "-" else sys.stdout
    print(_HEADER, file=table)
    results = []
    for name in GROUPS if group == "all" else (group,):
        for case in cases(name, size, _pipeline):
            results.append(measure(case, size))
            print(_line(results[-1]), file=table, flush=True)
    if json is not None:
        write_json(json, [r.row() for r in results])
    return 0


def _pipeline(packets: Packets) -> list[Velocity]:
    """The four stages in one process: what one core sustains without any network."""
    return run_offline(Settings(), RIG, packets)


_HEADER = f"{'':20s} {'median':>12s} {'peer':>12s} {'ratio':>8s}  {'n':>4s}"


def _line(r: Result) -> str:
    peer = ratio = ""
    if r.peer_median_us is not None:
        peer, ratio = _time(r.peer_median_us), f"{r.peer_median_us / r.median_us:.1f}"
    note = r.peer or ("" if r.mev_s is None else f"{r.mev_s:.1f} M events/s, both cameras")
    return f"{r.name:20s} {_time(r.median_us):>12s} {peer:>12s} {ratio:>8s}  {r.n:4d}  {note}".rstrip()


def _time(us: float) -> str:
    if us >= 1e3:
        return f"{us * 1e-3:.2f} ms"
    return f"{us:.2f} us" if us >= 1.0 else f"{us * 1e3:.1f} ns"
