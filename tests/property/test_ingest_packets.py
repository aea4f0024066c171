"""The batches depend on the streams alone, not on how they are cut into packets or interleaved."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from tests.moving_edges import T0_NS, Events, calibration, edges, imu_packet, settings
from velod.ingest.stage import IngestStage
from velod.types import EventBatch, EventPacket, ImuPacket, StereoBatch

END_NS = T0_NS + 100_000_000
# Coarse ticks make many events of one time; bursts and two directions make the surfaces matter.
LEFT = edges(speed=700.0, angle=0.5, tick_ns=500_000)
RIGHT = edges(speed=700.0, angle=0.5, tick_ns=500_000, shift_px=4.0)
IMU_T_NS = np.arange(T0_NS, END_NS, 5_000_000)
MODES = {
    "count": settings(batch="count", count=700),
    "time": settings(batch="time", period_ms=7.0),
    "first": settings(batch="first", count=900, period_ms=8.0, hot_pixel_hz=60.0, background_ms=30.0),
    "event": settings(mode="event", batch="first", count=900, period_ms=8.0, slice_ms=0.7),
}


def cut(events: Events, cuts: list[int], camera: str) -> list[EventPacket]:
    """Packets between the cuts (positions in the stream), each with the last watermark that it may claim."""
    bounds = [0, *sorted(c % len(events.x) for c in cuts), len(events.x)]
    out = []
    for seq, (a, b) in enumerate(pairwise(bounds)):
        known = END_NS if b == len(events.x) else int(events.t_ns[b])
        out.append(events[a:b].packet(seq, known, camera))
    return out


def batches(mode: str, packets: list[EventPacket | ImuPacket]) -> list[bytes]:
    ingest = IngestStage(MODES[mode], calibration())
    out = []
    for packet in packets:
        for m in ingest.handle(packet):
            if isinstance(m, EventBatch | StereoBatch):
                fields = [getattr(m, name) for name in m.__slots__]
                out.append(b"".join(f.tobytes() if isinstance(f, np.ndarray) else str(f).encode() for f in fields))
    return out


@cache
def whole(mode: str) -> list[bytes]:
    return batches(mode, [*cut(RIGHT, [], "right"), *cut(LEFT, [], "left")])


cuts = st.lists(st.integers(0, 10**6), max_size=40)


@examples(max_examples=30)
@given(st.sampled_from(sorted(MODES)), cuts, cuts, st.integers(0, 2**32 - 1))
def test_batches_are_bit_identical_however_the_streams_are_cut_and_interleaved(
    mode: str, left: list[int], right: list[int], seed: int
) -> None:
    streams: list[list[EventPacket] | list[ImuPacket]] = [
        cut(LEFT, left, "left"),
        cut(RIGHT, right, "right"),
        [imu_packet(i, [t]) for i, t in enumerate(IMU_T_NS.tolist())],
    ]
    turn = np.repeat(np.arange(3), [len(s) for s in streams])
    np.random.default_rng(seed).shuffle(turn)
    queues = [iter(s) for s in streams]
    packets = [next(queues[i]) for i in turn]
    assert batches(mode, packets) == whole(mode)


def test_the_streams_give_many_batches_with_selected_events() -> None:
    for mode in MODES:
        assert len(whole(mode)) >= 20
        assert len(set(whole(mode))) == len(whole(mode))
