"""``velod bench``: how long each part takes, beside a peer."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from velod.cli.bench_rate import rate
from velod.cli.exit import RunFailed
from velod.cli.files import write_json
from velod.cli.through_processes import free_port, through_the_processes
from velod.config import Settings, from_tree
from velod.eval import bench_input
from velod.eval.bench import Result, Size, measure
from velod.eval.bench_cases import GROUPS, cases
from velod.eval.bench_input import RIG
from velod.eval.bench_pipeline import Packets
from velod.eval.latency import LEGS, Trace
from velod.runtime.hop import measure as measure_hop
from velod.runtime.offline import run_offline
from velod.runtime.warmup import fill_cache
from velod.types import NS_PER_S, EventPacket, FlowBatch, Velocity
from velod.wire import Envelope
from velod.wire.topics import DEPTH, EVENTS, FLOW, IMU

_MORE: dict[str, Callable[[Size], list[Result]]] = {
    "hop": lambda size: hop(size),
    "latency": lambda size: latency(3.0 * size.dataflow_seconds),
    "rate": lambda size: rate(size.dataflow_seconds),
}
"""Groups of cases that are measured together, by name."""


def bench(group: str, json: str | None, size: Size | None = None) -> int:
    """Measure one of GROUPS or ``all``; a table on stdout (on stderr where the JSON goes there)."""
    size = size or Size()
    # One core for everyone: the peers' libraries would take all.
    cv2.setNumThreads(1)
    fill_cache(Settings(), RIG)
    table = sys.stderr if json == "-" else sys.stdout
    print(_HEADER, file=table)
    results = []
    for name in (*GROUPS, *_MORE) if group == "all" else (group,):
        if name in _MORE:
            results += (several := _MORE[name](size))
            for result in several:
                print(_line(result), file=table, flush=True)
            continue
        for case in cases(name, size, _pipeline):
            results.append(measure(case, size))
            print(_line(results[-1]), file=table, flush=True)
        if name == "pipeline":
            for whole in (dataflow, event_latency):
                results.append(whole(size.dataflow_seconds))
                print(_line(results[-1]), file=table, flush=True)
    if json is not None:
        write_json(json, [r.row() for r in results])
    return 0


def hop(size: Size) -> list[Result]:
    """``hop.velod`` and ``hop.zenoh``: a packet of 45,000 events (405 KB) between processes, each way in turn.

    velod's from before encoding to a checked message in a stage's hands, raw Zenoh's and the socket's as bytes.
    """
    n = size.repeats
    e = bench_input.events(size.seconds, 0.0, seed=2)
    first = slice(size.events)
    packet = EventPacket(
        0, int(e.t_ns[first][-1]), "left", e.x[first], e.y[first], e.t_ns[first].astype(np.int64), e.p[first]
    )
    try:
        us = measure_hop(packet, n, free_port())
    except TimeoutError as error:
        raise RunFailed(str(error)) from None
    return [
        Result("hop.velod", us["velod"], n, peer="raw Zenoh", peer_median_us=us["zenoh"]),
        Result("hop.zenoh", us["zenoh"], n, peer="Unix socket", peer_median_us=us["socket"]),
    ]


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
        optimizer=replace(settings.optimizer, max_wait_ms=math.inf),
        zenoh=replace(settings.zenoh, lossless=True),
    )
    result, events = through_the_processes(settings, seconds, speed=None)
    out = result.velocities
    host_us = (out[-1].t_pub_ns - out[0].t_pub_ns) / 1e3
    sensor_s = (out[-1].velocity.t_ns - out[0].velocity.t_ns) / NS_PER_S
    batches = out[-1].velocity.batch_seq - max(0, out[0].velocity.batch_seq)
    return Result("pipeline.sustained", host_us / batches, batches, mev_s=events / seconds * sensor_s / host_us)


def event_latency(seconds: float) -> Result:
    """``pipeline.event_to_flow``: event by event, in real time, from a driver's packet to the flow that it completes.

    At a million events a second and camera, between the moments of publication, with packets and slices of a
    millisecond; an event may have waited for as long in the packet. Raises RunFailed, SessionError.
    """
    settings = from_tree({"ingest": {"mode": "event"}})
    packets: dict[int, int] = {}  # end of the packet -> published at
    flows: dict[int, int] = {}  # end of the slice -> published at

    def note(envelope: Envelope) -> None:
        message = envelope.message
        if isinstance(message, EventPacket) and message.camera == "left":
            packets[message.t_ns] = envelope.t_pub_ns
        elif isinstance(message, FlowBatch):
            flows[message.t_ns] = envelope.t_pub_ns

    speed_px_s = bench_input.speed_for(1e6, RIG.left)
    through_the_processes(settings, seconds, 1.0, "1000hz", speed_px_s, on_envelope=note, topics=(EVENTS, FLOW))
    ends = np.array(sorted(packets))
    waited_ns = [
        published_ns - packets[int(ends[k])]
        for t_ns, published_ns in flows.items()
        if (k := int(np.searchsorted(ends, t_ns))) < len(ends)
    ]
    if not waited_ns:
        raise RunFailed("the processes put out no flow")
    p50_us, p99_us = (float(ns) / 1e3 for ns in np.percentile(waited_ns, (50, 99)))
    return Result("pipeline.event_to_flow", p50_us, len(waited_ns), p99_us=p99_us)


def latency(seconds: float) -> list[Result]:
    """``latency.*``: from a batch's closing to its velocity in real time, with as many events as in corridor-2.

    Medians and p99, by the stamps of the messages: to its flow and to its depth; from the moment when everything is
    there that the velocity is made of; and in all, with the wait for the next moment of an output. Raises RunFailed,
    SessionError.
    """
    trace = Trace()
    through_the_processes(
        Settings(), seconds, 1.0, speed_px_s=bench_input.CORRIDOR_2_PX_S,
        on_envelope=trace.note, on_velocity=lambda p: trace.note(Envelope(p.velocity, p.t_pub_ns, p.t_origin_ns)),
        topics=(FLOW, DEPTH, IMU),
    )  # fmt: skip
    legs = trace.legs()
    if not len(legs[LEGS[0]]):
        raise RunFailed("no velocity was made of a batch")
    return [
        Result(f"latency.{name}", float(np.median(ns)) / 1e3, len(ns), p99_us=float(np.percentile(ns, 99)) / 1e3)
        for name, ns in legs.items()
    ]


_HEADER = f"{'':20s} {'median':>12s} {'peer':>12s} {'ratio':>8s}  {'n':>4s}"


def _line(r: Result) -> str:
    peer = ratio = ""
    if r.peer_median_us is not None:
        peer, ratio = _time(r.peer_median_us), f"{r.peer_median_us / r.median_us:.1f}"
    notes = [
        r.peer or "",
        "" if r.p99_us is None else f"p99 {_time(r.p99_us)}",
        "" if r.mev_s is None else f"{r.mev_s:.1f} M events/s, both cameras",
        *(f"{name} {value:.3g}" for name, value in r.more.items()),
    ]
    note = ", ".join(filter(None, notes))
    return f"{r.name:20s} {_time(r.median_us):>12s} {peer:>12s} {ratio:>8s}  {r.n:4d}  {note}".rstrip()


def _time(us: float) -> str:
    if us >= 1e3:
        return f"{us * 1e-3:.2f} ms"
    return f"{us:.2f} us" if us >= 1.0 else f"{us * 1e3:.1f} ns"
