"""What is measured of flow, depth and the codec: cases of ``velod bench``."""

from __future__ import annotations

import math
import pickle
import time
from dataclasses import fields, replace
from typing import Any

import cv2
import numpy as np

from velod.config import Settings, from_tree
from velod.depth.stage import DepthStage
from velod.depth.time_surface import decay_table
from velod.depth.zncc import Surface, match
from velod.eval import bench_input
from velod.eval.bench import Case, Size
from velod.eval.bench_input import RIG
from velod.events.plane_fit import SIZE
from velod.events.sae import update_sae
from velod.events.sensor_size import for_sensor
from velod.events.surface_clock import SurfaceClock
from velod.flow.stage import FlowStage
from velod.ingest.stage import IngestStage
from velod.types import (
    F64,
    EventBatch,
    EventPacket,
    FlowBatch,
    Message,
    StereoBatch,
)
from velod.wire import decode, encode


def selected(size: Size) -> tuple[EventBatch, StereoBatch]:
    """What ingest makes of the newest full batch of the stream."""
    stage = IngestStage(Settings(), RIG)
    batches: dict[type, Any] = {}
    for packet in bench_input.packets(size.seconds, seed=1):
        for message in stage.handle(packet):
            batches[type(message)] = message
    return batches[EventBatch], batches[StereoBatch]


def sae(size: Size) -> Case:
    """``events.sae``: one event into both surfaces."""
    e = bench_input.events(size.seconds, 0.0, seed=2)
    n = min(size.events, len(e.t_ns))
    h, w = RIG.left.height, RIG.left.width
    clock = SurfaceClock(h, w)
    first, last = clock.new_surface(), clock.new_surface()
    x, y, t_ns, p = e.x[:n], e.y[:n], e.t_ns[:n].copy(), e.p[:n]
    lap_ns = int(t_ns[-1] - t_ns[0]) + 1

    def run() -> None:
        # The same events over and over, each time later.
        np.add(t_ns, lap_ns, out=t_ns)
        for part in clock.spans(t_ns):
            update_sae(x[part], y[part], t_ns[part], p[part], first, last, 10_000_000, clock.epoch_ns)

    return Case("events.sae", run, per=n)


def plane_fit(batch: EventBatch) -> Case:
    """``flow.plane_fit``: the flow of one event from its 5x5, against numpy's least squares on each patch."""
    stage, n = FlowStage(Settings(), RIG), len(batch.x)
    batch = replace(batch, ring=batch.ring[:0])
    offset = np.arange(SIZE)
    A = np.column_stack([offset % 5 - 2.0, offset // 5 - 2.0, np.ones(SIZE)])

    def run() -> FlowBatch:
        return stage.handle(batch)[0]

    def run_peer() -> F64:
        speed = np.empty(n)
        for i in range(n):
            age_s = batch.patch[i] * 1e-9
            there = age_s > 0.0
            gradient, *_ = np.linalg.lstsq(A[there], -age_s[there], rcond=None)
            speed[i] = 1.0 / math.hypot(gradient[0], gradient[1])
        return speed

    def disagreement() -> float:
        """Median relative difference of the speeds: the peer rejects no outliers."""
        flow = run()
        return float(np.median(np.abs(run_peer()[flow.index] / flow.speed - 1.0)))

    return Case("flow.plane_fit", run, n, "numpy lstsq per patch", run_peer, n, disagreement, slow=True)


def event_by_event(size: Size) -> Case:
    """``flow.event_by_event``: a flow in event-by-event mode where every event that can gives one, all in.

    From left events on: checks, surfaces, selection, slices, and the flow worker's fits, for ``size.events`` at a
    time, divided by the flows that come of them.
    """
    settings = from_tree({"ingest": {"mode": "event", "rest_ms": 0.0, "batch": "count", "count": size.events}})
    ingest, flow = IngestStage(settings, RIG), FlowStage(settings, RIG)
    stream = bench_input.batch_packets(size.seconds, size.events)

    def run() -> int:
        left, right = next(stream)
        # Flow needs one camera: the other is only as far.
        messages = ingest.handle(EventPacket(right.seq, right.t_ns, "right", *(c[:0] for c in columns(right))))
        start_ns = time.perf_counter_ns()
        messages += ingest.handle(left)
        flows = sum(len(flow.handle(m)[0].index) for m in messages if isinstance(m, EventBatch))
        # There are none where the stream begins anew.
        return (time.perf_counter_ns() - start_ns) // max(flows, 1)

    return Case("flow.event_by_event", run, clocked=True)


def columns(packet: EventPacket) -> tuple[np.ndarray, ...]:
    """x, y, event_t_ns and p."""
    return packet.x, packet.y, packet.event_t_ns, packet.p


def sparse_depth(batch: StereoBatch) -> Case:
    """``depth.sparse_500``: block matching at the selected events, against OpenCV's dense StereoBM.

    Both from time surfaces: ours includes the integral images. As many disparities and as large a block.
    """
    s = for_sensor(Settings(), RIG.left.width, RIG.left.height).depth
    table = decay_table(batch.unit_ns, 1e-3 * s.tau_ms)
    left, right = np.take(table, batch.left_last), np.take(table, batch.right_last)
    x, y = batch.x.astype(np.int64), batch.y.astype(np.int64)
    grey = [np.round(255.0 * surface).astype(np.uint8) for surface in (left, right)]
    matcher = cv2.StereoBM.create(numDisparities=48, blockSize=17)

    def run() -> np.ndarray:
        mirrored = Surface.of(np.ascontiguousarray(right[:, ::-1]))
        return match(Surface.of(left), mirrored, x, y, s.block_px, s.max_disparity_px).disparity

    def run_peer() -> np.ndarray:
        return matcher.compute(*grey)

    def disagreement() -> float:
        """Median difference in px where both found something."""
        ours, peer = run(), run_peer()[y, x] / 16.0
        both = np.isfinite(ours) & (peer >= 0.0)
        return float(np.median(np.abs(ours[both] - peer[both])))

    return Case("depth.sparse_500", run, 1, "OpenCV StereoBM dense, 17x17, 48", run_peer, 1, disagreement)


def worker(name: str, stage: FlowStage | DepthStage, message: EventBatch | StereoBatch) -> Case:
    """A worker's whole work on a batch: decode, compute, encode."""
    data = encode(message, 1)

    def run() -> list[bytes]:
        received: Any = decode(data).message
        return [encode(answer, 1) for answer in stage.handle(received)]

    return Case(name, run)


def codec(messages: tuple[Message, ...]) -> Case:
    """``codec.batch``: both messages of a batch to bytes and back with all checks, against pickle, which has none."""

    def run() -> list[Message]:
        return [decode(encode(m, 1)).message for m in messages]

    def run_peer() -> list[Message]:
        return [pickle.loads(pickle.dumps(m, pickle.HIGHEST_PROTOCOL)) for m in messages]

    def disagreement() -> float:
        """Number of fields that differ from the peer's."""
        return float(sum(_differing(ours, peer) for ours, peer in zip(run(), run_peer(), strict=True)))

    return Case("codec.batch", run, 1, "pickle", run_peer, 1, disagreement)


def _differing(a: Message, b: Message) -> int:
    return sum(not np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
