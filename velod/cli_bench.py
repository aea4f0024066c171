"""``velod bench``: how long each part takes, beside a peer."""

from __future__ import annotations

import math
import socket
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2

from velod.cli_exit import RunFailed
from velod.cli_report import write_json
from velod.config import Settings
from velod.eval.bench import Result, Size, measure
from velod.eval.bench_cases import GROUPS, Packets, cases
from velod.eval.bench_input import RIG, record
from velod.runtime.offline import run_offline
from velod.runtime.online import OnlineError, run_online
from velod.runtime.player import player_command
from velod.runtime.warmup import fill_cache
from velod.types import NS_PER_S, Velocity


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
        if name == "pipeline":
            results.append(dataflow(size.dataflow_seconds))
            print(_line(results[-1]), file=table, flush=True)
    if json is not None:
        write_json(json, [r.row() for r in results])
    return 0


def _pipeline(packets: Packets) -> list[Velocity]:
    """The four stages in one process: what one core sustains without any network."""
    return run_offline(Settings(), RIG, packets)


def dataflow(seconds: float) -> Result:
    """``pipeline.sustained``: what all processes sustain together, from a recording read as fast as it goes.

    Nothing is lost on the way. From the first velocity to the last one, so without the start; a unit is a batch.
    Raises RunFailed, SessionError.
    """
    settings = Settings()
    settings = replace(
        settings,
        rig=replace(settings.rig, name="bench"),
        optimizer=replace(settings.optimizer, max_wait_ms=math.inf),
        zenoh=replace(settings.zenoh, lossless=True, port=_free_port()),
    )
    trouble: list[str] = []
    with TemporaryDirectory() as directory:
        path = Path(directory) / "stream.h5"
        events = record(path, seconds, seed=1)
        driver = player_command(str(path), settings.zenoh, settings.rig.name, None)
        try:
            out = run_online(settings, RIG, driver, on_line=trouble.append).velocities
        except OnlineError as e:
            raise RunFailed(str(e)) from None
    if len(out) < 2 or out[-1].t_pub_ns == out[0].t_pub_ns:
        raise RunFailed("the processes put out nothing: " + "; ".join(trouble[-3:]))
    host_us = (out[-1].t_pub_ns - out[0].t_pub_ns) / 1e3
    sensor_s = (out[-1].velocity.t_ns - out[0].velocity.t_ns) / NS_PER_S
    batches = out[-1].velocity.batch_seq - max(0, out[0].velocity.batch_seq)
    return Result("pipeline.sustained", host_us / batches, None, None, batches, events / seconds * sensor_s / host_us)


def _free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port: int = s.getsockname()[1]
        return port


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
