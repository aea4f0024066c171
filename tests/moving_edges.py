"""Events of straight, parallel edges that sweep over two small sensors at a known normal flow."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from velod.config import Settings, from_tree
from velod.geometry.calibration import Calibration, Camera
from velod.types import EventBatch, EventPacket, ImuPacket

WIDTH, HEIGHT, FOCAL, BASELINE_M = 64, 48, 60.0, 0.1
T0_NS = 1_000_000_000


def calibration(model: str = "none", dist: tuple[float, ...] = (), time_offset_s: float = 0.0) -> Calibration:
    camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, model, dist)
    return Calibration(camera, camera, np.eye(3), np.array([-BASELINE_M, 0, 0]), time_offset_s=time_offset_s)


def settings(**ingest: object) -> Settings:
    return from_tree({"ingest": {"count": 500, "period_ms": 10.0, "quota": 50, **ingest}})


@dataclass
class Events:
    x: np.ndarray
    y: np.ndarray
    t_ns: np.ndarray
    p: np.ndarray

    def __getitem__(self, i: slice | np.ndarray) -> Events:
        return Events(self.x[i], self.y[i], self.t_ns[i], self.p[i])

    def packet(self, seq: int, t_ns: int | None = None, camera: str = "left") -> EventPacket:
        if t_ns is None:
            t_ns = int(self.t_ns[-1])
        return EventPacket(seq, t_ns, camera, self.x, self.y, self.t_ns, self.p)


def edges(
    speed: float = 500.0,
    angle: float = 0.0,
    seconds: float = 0.1,
    spacing_px: float = 20.0,
    shift_px: float = 0.0,
    burst: int = 2,
    tick_ns: int = 1000,
) -> Events:
    """Edges with normal (cos angle, sin angle), every ``spacing_px``, of alternating polarity, moving along it.

    Each crossing of a pixel fires ``burst`` events, 1 ms apart; times are whole ``tick_ns`` from T0_NS on.
    """
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    along = (x + shift_px) * math.cos(angle) + y * math.sin(angle)
    rows = []
    for k in range(-200, 200):
        t = (along + k * spacing_px) / speed
        for j in range(burst):
            s = (t + j * 1e-3 >= 0) & (t + j * 1e-3 < seconds)
            t_ns = T0_NS + np.round((t[s] + j * 1e-3) * 1e9 / tick_ns).astype(np.int64) * tick_ns
            rows.append(np.column_stack([x[s], y[s], t_ns, np.full(len(t_ns), k % 2)]))
    e = np.vstack(rows)
    e = e[np.lexsort((e[:, 3], e[:, 0], e[:, 1], e[:, 2]))]
    return Events(e[:, 0].astype(np.uint16), e[:, 1].astype(np.uint16), e[:, 2].copy(), e[:, 3].astype(np.uint8))


def imu_packet(
    seq: int, t_ns: np.ndarray | list[int], accel: np.ndarray | None = None, gyro: np.ndarray | None = None
) -> ImuPacket:
    """Samples that differ from each other; ``t_ns`` of the packet is the last sample's."""
    t = np.asarray(t_ns, np.int64)
    wobble = np.column_stack([np.sin(t * 1e-6), np.cos(t * 1e-6), 0.1 * np.sin(t * 3e-6)])
    return ImuPacket(
        seq,
        int(t[-1]) if len(t) else 0,
        t,
        wobble + np.array([0, 0, 9.81]) if accel is None else accel,
        wobble if gyro is None else gyro,
    )


def event_batches(messages: list[object]) -> list[EventBatch]:
    return [m for m in messages if isinstance(m, EventBatch)]
