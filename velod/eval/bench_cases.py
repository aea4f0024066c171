"""What is measured, by the names that ``velod bench --json`` writes."""

from __future__ import annotations

import math
import pickle
import time
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from itertools import count
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
from velod.optimizer.batch_fit import Fit, solve
from velod.optimizer.bins import compress
from velod.optimizer.estimator import Estimator
from velod.optimizer.flow_equation import Rows, body_rows, on_velocity
from velod.optimizer.interval import BLOCK
from velod.optimizer.stage import OptimizerStage
from velod.optimizer.window import Window
from velod.types import (
    F64,
    NS_PER_S,
    DepthBatch,
    EventBatch,
    EventPacket,
    FlowBatch,
    ImuPacket,
    Message,
    Odometry,
    StereoBatch,
    Velocity,
)
from velod.wire import decode, encode

GROUPS = ("flow", "depth", "solve", "codec", "pipeline")

_V_AND_BW = [0, 1, 2, 6, 7, 8]
"""Of Window.selector's rows: spline and gyroscope bias."""

Packets = Iterator[EventPacket | ImuPacket]
RunPipeline = Callable[[Packets], list[Velocity]]


def cases(group: str, size: Size, run_pipeline: RunPipeline) -> Iterator[Case]:
    """The cases of one of GROUPS, each made when its turn comes. ``run_pipeline``: the stages chained."""
    if group == "flow":
        yield sae(size)
        event_batch, _ = selected(size)
        yield plane_fit(event_batch)
        yield event_by_event(size)
        yield worker("flow.worker", FlowStage(Settings(), RIG), event_batch)
    elif group == "depth":
        _, stereo_batch = selected(size)
        yield sparse_depth(stereo_batch)
        yield worker("depth.worker", DepthStage(Settings(), RIG), stereo_batch)
    elif group == "solve":
        yield window(size)
        yield imu_rate(size)
    elif group == "codec":
        yield codec(selected(size))
    elif group == "pipeline":
        yield ingest(size)
        yield large_ingest(size)
        yield one_process(size, run_pipeline)
    else:
        raise ValueError(f"no group {group!r}; groups: {', '.join(GROUPS)}")


def selected(size: Size) -> tuple[EventBatch, StereoBatch]:
    """What ingest makes of the newest full batch of the stream."""
    stage = IngestStage(Settings(), RIG)
    batches: dict[type, Any] = {}
    for packet in bench_input.packets(size.seconds, seed=1):
        for message in stage.handle(packet):
            batches[type(message)] = message
    return batches[EventBatch], batches[StereoBatch]


# --- flow ---


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
    ingest, flow, stream = IngestStage(settings, RIG), FlowStage(settings, RIG), _batch_packets(size)

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


# --- depth ---


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


# --- workers and codec ---


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


# --- solve ---


def window(size: Size) -> Case:
    """``solve.window``: a batch taken in by a full window, all in.

    Rows, fit, compression, inertial factors, solution and covariance; against normal equations of all rows of the
    window by dense numpy, which lack the IMU.
    """
    warm = size.window + size.window // 4
    stream = list(bench_input.estimates(warm + size.repeats + 1, size.flows, seed=3))
    # The peer stays in the window at which ``run`` begins.
    still, estimator = Estimator(Settings(), RIG), Estimator(Settings(), RIG)
    for imu, flow, depth in stream[:warm]:
        for e in (still, estimator):
            e.add_imu(imu)
            e.absorb(flow, depth)
    batches = [_rows(flow, depth) for _, flow, depth in stream[warm - size.window : warm]]
    ahead = iter(stream[warm:])

    def run() -> None:
        imu, flow, depth = next(ahead)
        estimator.add_imu(imu)
        estimator.absorb(flow, depth)

    def run_peer() -> tuple[F64, F64]:
        H, h = dense_normal_equations(still.window, batches)
        # The IMU's factors, which determine the other states, cost the peer nothing.
        H[np.diag_indices_from(H)] += 1.0
        cov: F64 = np.asarray(np.linalg.inv(H), np.float64)
        return cov @ h, cov[-BLOCK:, -BLOCK:]

    def disagreement() -> float:
        """Of one batch's information, relative: compression takes the spline as constant over 5 ms."""
        rows, fit = batches[-1]
        H, _ = dense_normal_equations(still.window, batches[-1:])
        compressed = np.zeros_like(H)
        bins = compress(rows, np.zeros((len(rows.z), 3)), fit, 1.0, np.zeros(3))
        for t_ns, L in zip(bins.t_ns, bins.L, strict=True):
            at = still.window.selector(t_ns)[_V_AND_BW]
            compressed += at.T @ L[:6, :6] @ at
        return float(np.abs(compressed - H).max() / np.abs(H).max())

    return Case("solve.window", run, 1, "dense numpy of all rows", run_peer, 1, disagreement, slow=True)


def _rows(flow: FlowBatch, depth: DepthBatch) -> tuple[Rows, Fit]:
    """A batch of ``bench_input.estimates`` as rows on v_B with robust weights; camera and IMU are one."""
    camera = (RIG.left.fx, RIG.left.cx, RIG.left.cy)
    a_B, b_B = body_rows((flow.x, flow.y), flow.n, depth.inv_depth, camera, np.eye(3), np.zeros(3))
    t_ns = flow.t_ns - flow.age.astype(np.int64)
    rows = on_velocity(t_ns, flow.speed.astype(np.float64), a_B, b_B, np.zeros_like(b_B))
    rows.sigma[:] = flow.sigma
    fit = solve(rows, Settings().optimizer.ransac_iterations, seed=1)
    assert fit is not None, "the rows of the made-up input determine a velocity"
    return rows, fit


def dense_normal_equations(states: Window, batches: list[tuple[Rows, Fit]]) -> tuple[F64, F64]:
    """H (n, n) and h (n,) of all rows on the states of the window, one row of J (m, n) per flow."""
    t_ns, z, a, b = (np.concatenate([getattr(r, name) for r, _ in batches]) for name in ("t_ns", "z", "a", "b"))
    w = np.concatenate([fit.weight / (rows.sigma * fit.scale) ** 2 for rows, fit in batches])
    knot_ns = int(Settings().optimizer.knot_s * NS_PER_S)
    segment = t_ns // knot_ns
    J = np.zeros((len(z), states.size))
    for k in range(states.first, states.last + 1):
        here = np.flatnonzero(segment == k)
        weights = _basis((t_ns[here] - k * knot_ns) / knot_ns)
        for column, weight in zip(states.control_columns(k), weights, strict=True):
            J[here, column : column + 3] = weight[:, None] * a[here]
        J[np.ix_(here, states.bias_columns(k)[3:])] = -b[here]
    weighted = J * w[:, None]
    return weighted.T @ J, weighted.T @ z


def _basis(u: F64) -> F64:
    """The four weights of Eq. 7, each (m,)."""
    return np.stack([(1 - u) ** 3, 4 - 6 * u**2 + 3 * u**3, 1 + 3 * u + 3 * u**2 - 3 * u**3, u**3]) / 6.0


def imu_rate(size: Size) -> Case:
    """``output.imu_rate``: all that a velocity between two batches costs the stage, as bytes.

    It is carried there by the IMU, with covariance, attitude, judgement and dead reckoning.
    """
    stage = OptimizerStage(Settings(), RIG)
    stream = list(bench_input.estimates(size.window, size.flows, seed=3))
    out = [answer for batch in stream for message in batch for answer in stage.handle(message)]
    assert isinstance(out[-1], Odometry), "the made-up input ends with a valid velocity"
    # Another moment each time, as the estimator remembers what it has predicted.
    later_ns = count(stream[-1][1].t_ns + 5_000_000, 1_000)

    def run() -> list[bytes]:
        return [encode(answer, 1) for answer in stage.put_out(next(later_ns))]

    return Case("output.imu_rate", run)


# --- pipeline ---


def ingest(size: Size) -> Case:
    """``ingest.batch``: as many left and right events as a batch has: surfaces, selection, encoding."""
    settings = from_tree({"ingest": {"batch": "count", "count": size.events}})
    stage, stream = IngestStage(settings, RIG), _batch_packets(size)

    def run() -> list[bytes]:
        left, right = next(stream)
        return [encode(message, 1) for packet in (left, right) for message in stage.handle(packet)]

    return Case("ingest.batch", run)


def large_ingest(size: Size) -> Case:
    """``ingest.hd``: a whole stream of a 1280x720 pair as ingest's process handles it.

    Decoding of packets, filters, surfaces, selection, encoding. ``mev_s`` counts the events of both cameras.
    """
    packets = [encode(packet, 1) for packet in bench_input.large_packets(size.seconds, seed=1)]
    events = sum(len(packet.x) for packet in bench_input.large_packets(size.seconds, seed=1))

    def run() -> int:
        stage = IngestStage(Settings(), bench_input.LARGE_RIG)
        started_ns = time.perf_counter_ns()
        for data in packets:
            received: Any = decode(data).message
            for message in stage.handle(received):
                encode(message, 1)
        return time.perf_counter_ns() - started_ns

    return Case("ingest.hd", run, events=events, clocked=True)


def _batch_packets(size: Size) -> Iterator[tuple[EventPacket, EventPacket]]:
    """Left packets of ``size.events`` and the right events up to the same time; the stream is repeated for ever."""
    left, right = (bench_input.events(size.seconds, d, seed=2) for d in (0.0, bench_input.DISPARITY_PX))
    ends = np.arange(size.events, len(left.t_ns), size.events)
    edges_ns = left.t_ns[ends]
    seqs = count()
    for lap in count():
        shift_ns = lap * int(size.seconds * NS_PER_S)
        start_ns = 0
        for seq, edge_ns in zip(seqs, [0, *edges_ns.tolist()], strict=False):
            pair = []
            for camera, e in (("left", left), ("right", right)):
                part = slice(*np.searchsorted(e.t_ns, [start_ns, edge_ns]).tolist())
                t_ns = e.t_ns[part] + shift_ns
                pair.append(EventPacket(seq, edge_ns + shift_ns, camera, e.x[part], e.y[part], t_ns, e.p[part]))
            start_ns = edge_ns
            if edge_ns:
                yield pair[0], pair[1]


def one_process(size: Size, run_pipeline: RunPipeline) -> Case:
    """``pipeline.one_process``: the stages chained on a whole stream, without network; a unit is a batch.

    ``mev_s`` counts the events of both cameras.
    """
    packets = list(bench_input.packets(size.seconds, seed=1))
    events = sum(len(p.x) for p in packets if isinstance(p, EventPacket))
    batches = max(1, round(events / 2 / size.events))

    def run() -> int:
        started_ns: list[int] = []
        run_pipeline(_noting_the_start(packets, started_ns))
        return time.perf_counter_ns() - started_ns[0]

    return Case("pipeline.one_process", run, per=batches, events=events, clocked=True)


def _noting_the_start(packets: list[EventPacket | ImuPacket], started_ns: list[int]) -> Packets:
    """The packets; when the first is asked for, the stages have been built."""
    started_ns.append(time.perf_counter_ns())
    yield from packets
