"""What the benchmark computes on: made from a seed in closed form, so that it needs no recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np

from velod.geometry.calibration import Calibration, Camera
from velod.geometry.camera import motion_field_rows
from velod.geometry.rectify import rectify
from velod.io.model import EventColumns, Imu
from velod.io.sequence import RecordingWriter
from velod.types import F64, NS_PER_S, DepthBatch, EventPacket, FlowBatch, ImuPacket, ImuSamples

CAMERA = Camera(width=346, height=260, fx=231.5, fy=231.5, cx=172.5, cy=129.5)
RIG = Calibration(left=CAMERA, right=CAMERA, R_RL=np.eye(3), t_RL=np.array([-0.12, 0.0, 0.0]))

VGA_CAMERA = Camera(width=640, height=480, fx=428.2, fy=428.2, cx=319.5, cy=239.5)
VGA_RIG = Calibration(left=VGA_CAMERA, right=VGA_CAMERA, R_RL=np.eye(3), t_RL=np.array([-0.12, 0.0, 0.0]))
LARGE_CAMERA = Camera(width=1280, height=720, fx=856.4, fy=856.4, cx=639.5, cy=359.5)
LARGE_RIG = Calibration(left=LARGE_CAMERA, right=LARGE_CAMERA, R_RL=np.eye(3), t_RL=np.array([-0.12, 0.0, 0.0]))
LARGE_SPEED_PX_S = 125.0

SPEED_PX_S, SLANT, DISPARITY_PX = 500.0, 0.5, 8.0
CORRIDOR_2_PX_S = 650.0
"""Makes as many events as corridor-2: 5.6 M a second and camera, 124 batches."""
SPACING_PX = (12.0, 30.0)
"""Of neighbouring edges; irregular, as block matching could not tell even ones apart."""
BURST, BURST_NS = 2, 1_000_000
JITTER_S = 5e-5

IMU_NS = 5_000_000
PACKET_NS = 5_000_000
ACCEL_NOISE, GYRO_NOISE = 1.86e-2 * 200**0.5, 1.86e-3 * 200**0.5  # of one sample at 200 Hz
_SCENE_SEED = 7  # both cameras see the same edges
_UP = np.array([0.0, -9.81, 0.0])


@dataclass(frozen=True, slots=True)
class Columns:
    """Events of one camera in time order."""

    x: np.ndarray
    y: np.ndarray
    t_ns: np.ndarray
    p: np.ndarray


def events(
    seconds: float, shift_px: float, seed: int, camera: Camera = CAMERA, speed_px_s: float = SPEED_PX_S
) -> Columns:
    """Slanted edges of alternating polarity that slide to the right; each passage of a pixel is a burst of two.

    About 4.3 M events a second by default; as many more as there are pixels, and as they are faster.
    """
    y, x = (c.ravel() for c in np.mgrid[: camera.height, : camera.width])
    # Edges lean one way above the middle and the other way below, so that their flows determine a velocity.
    along_px = x + shift_px - np.where(y < camera.height / 2, SLANT, -SLANT) * y
    scene, noise = np.random.default_rng(_SCENE_SEED), np.random.default_rng(seed)
    travelled_px = along_px.max() - along_px.min() + seconds * speed_px_s
    rightmost_px = camera.width + SLANT * camera.height + 64.0
    edges_px = rightmost_px - np.cumsum(scene.uniform(*SPACING_PX, int(2 * travelled_px / sum(SPACING_PX)) + 8))
    t_ns, at, p = [], [], []
    for k, edge_px in enumerate(edges_px.tolist()):
        t_s = (along_px - edge_px) / speed_px_s
        seen = np.flatnonzero((t_s > 0.0) & (t_s < seconds))
        first_ns = np.round((t_s[seen] + noise.normal(0.0, JITTER_S, len(seen))) * 1e6).astype(np.int64) * 1000
        t_ns += [first_ns + j * BURST_NS for j in range(BURST)]
        at += [seen] * BURST
        p.append(np.full(BURST * len(seen), k % 2, np.uint8))
    t, i, q = np.concatenate(t_ns), np.concatenate(at), np.concatenate(p)
    kept = np.flatnonzero((t > 0) & (t < seconds * NS_PER_S))
    order = kept[np.argsort(t[kept], kind="stable")]
    return Columns(x[i[order]].astype(np.uint16), y[i[order]].astype(np.uint16), t[order], q[order])


def large_packets(seconds: float, seed: int) -> Iterator[EventPacket]:
    """Packets of both cameras of LARGE_RIG, every 5 ms: 22 M events a second."""
    sides = {
        camera: events(seconds, shift_px, seed, LARGE_CAMERA, LARGE_SPEED_PX_S)
        for camera, shift_px in (("left", 0.0), ("right", DISPARITY_PX))
    }
    for seq in range(int(seconds * NS_PER_S) // PACKET_NS):
        start, end = seq * PACKET_NS, (seq + 1) * PACKET_NS
        for camera, e in sides.items():
            yield _packet(seq, camera, e, start, end)


def packets(seconds: float, seed: int) -> Iterator[EventPacket | ImuPacket]:
    """Both cameras and a resting IMU (the rig moves uniformly) as a driver sends them, every 5 ms."""
    rng = np.random.default_rng(seed)
    sides = {"left": events(seconds, 0.0, seed + 1), "right": events(seconds, DISPARITY_PX, seed + 2)}
    for seq in range(int(np.ceil(seconds * NS_PER_S / PACKET_NS))):
        start, end = seq * PACKET_NS, (seq + 1) * PACKET_NS
        sample_t_ns = np.arange(start, end, IMU_NS, dtype=np.int64)
        accel, gyro = _at_rest(len(sample_t_ns), rng)
        yield ImuPacket(seq, int(sample_t_ns[-1]), sample_t_ns, accel, gyro)
        for camera, e in sides.items():
            yield _packet(seq, camera, e, start, end)


def _packet(seq: int, camera: str, e: Columns, start_ns: int, end_ns: int) -> EventPacket:
    part = slice(*np.searchsorted(e.t_ns, [start_ns, end_ns]).tolist())
    return EventPacket(seq, end_ns, camera, e.x[part], e.y[part], e.t_ns[part], e.p[part])


def speed_for(rate_hz: float, camera: Camera) -> float:
    """Speed of the edges, px/s, at which ``camera`` has so many events a second."""
    return rate_hz * sum(SPACING_PX) / 2 / (BURST * camera.width * camera.height)


def true_velocity(speed_px_s: float, rig: Calibration) -> F64:
    """v_B (3,), m/s, of a rig that sees the stream slide to the right, all of it at the same disparity d.

    v_x = -speed Z / f, and Z = f b / d.
    """
    baseline_m = -float(rig.t_RL[0])
    return np.array([-speed_px_s * baseline_m / DISPARITY_PX, 0.0, 0.0])


def record(path: Path, seconds: float, seed: int, speed_px_s: float = SPEED_PX_S, rig: Calibration = RIG) -> int:
    """Write the stream of ``packets``, as ``rig`` sees it, as a recording; returns the number of events of both
    cameras.
    """
    written = 0
    with RecordingWriter(path, rig, packed=False) as writer:
        for side, shift_px in (("left", 0.0), ("right", DISPARITY_PX)):
            e = events(seconds, shift_px, seed, rig.left, speed_px_s)
            writer.append(side, EventColumns(t_ns=e.t_ns, x=e.x, y=e.y, p=e.p))
            written += len(e.t_ns)
        t_ns = np.arange(0, int(seconds * NS_PER_S), IMU_NS, dtype=np.int64)
        writer.finish(Imu(t_ns, *_at_rest(len(t_ns), np.random.default_rng(seed))))
    return written


def estimates(
    batches: int, flows: int, seed: int, period_ns: int = NS_PER_S // 75
) -> Iterator[tuple[ImuSamples, FlowBatch, DepthBatch]]:
    """What a perfect front end with noise says of a rig in uniform motion: input of the optimizer, batch by batch.

    One direction in ten is wrong. The IMU is a batch ahead, as the newest samples of a real one are.
    """
    rng, rect = np.random.default_rng(seed), rectify(RIG)
    sent_ns = -IMU_NS
    for seq in range(batches):
        t_ns = (seq + 1) * period_ns
        sample_t_ns = np.arange(sent_ns + IMU_NS, t_ns + period_ns, IMU_NS, dtype=np.int64)
        sent_ns = int(sample_t_ns[-1])
        imu = ImuSamples(seq, sent_ns, t_ns, seq, t_ns, sample_t_ns, *_at_rest(len(sample_t_ns), rng))
        x, y = rng.uniform(20, CAMERA.width - 20, flows), rng.uniform(20, CAMERA.height - 20, flows)
        angle, inv_depth = rng.uniform(0.0, 2.0 * np.pi, flows), rng.uniform(0.2, 0.6, flows)
        n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        nA, _ = motion_field_rows(x, y, rect.f, rect.cx, rect.cy, n)
        speed = inv_depth * (nA @ np.array([2.0, 0.5, 1.0]))
        n *= np.where(speed < 0.0, -1.0, 1.0)[:, None]
        speed = np.abs(speed) + 5.0 * np.abs(rng.normal(size=flows)) * (rng.random(flows) < 0.1) + 0.1
        yield imu, *_batches(seq, t_ns, period_ns, rng, x, y, n, speed, inv_depth)


def _at_rest(samples: int, rng: np.random.Generator) -> tuple[F64, F64]:
    return _UP + rng.normal(0.0, ACCEL_NOISE, (samples, 3)), rng.normal(0.0, GYRO_NOISE, (samples, 3))


def _batches(
    seq: int,
    t_ns: int,
    period_ns: int,
    rng: np.random.Generator,
    x: F64,
    y: F64,
    n: F64,
    speed: F64,
    inv_depth: F64,
) -> tuple[FlowBatch, DepthBatch]:
    m, f32 = len(x), np.float32
    index = np.arange(m, dtype=np.uint16)
    age = rng.integers(1, period_ns, m).astype(np.uint32)
    sigma = (1.0 + 0.02 * speed).astype(f32)
    flow = FlowBatch(seq, t_ns, m, index, age, x.astype(f32), y.astype(f32), n.astype(f32), speed.astype(f32), sigma)
    fb = CAMERA.fx * -float(RIG.t_RL[0])
    depth = DepthBatch(
        seq,
        t_ns,
        m,
        index,
        (inv_depth * fb).astype(f32),
        inv_depth.astype(f32),
        np.full(m, 0.06 / fb, f32),
        np.ones(m, np.uint8),
    )
    return flow, depth


def batch_packets(seconds: float, n: int) -> Iterator[tuple[EventPacket, EventPacket]]:
    """Left packets of ``n`` events and the right events up to the same time; the stream is repeated for ever."""
    left, right = (events(seconds, d, seed=2) for d in (0.0, DISPARITY_PX))
    ends = np.arange(n, len(left.t_ns), n)
    edges_ns = left.t_ns[ends]
    seqs = count()
    for lap in count():
        shift_ns = lap * int(seconds * NS_PER_S)
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
