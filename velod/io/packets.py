"""Recordings -> packets in sensor-time order, as a driver would publish them."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from velod.io.model import NO_EVENTS, EventColumns, EventSource, Imu, RecordingError
from velod.types import NS_PER_S, EventPacket, ImuPacket

FINAL_WATERMARK_NS = 25_000_000
"""The last, empty packet of each camera says that nothing happens until so long after the recording's end."""

_SEAM_NS = 5_000_000
"""Between the last moment of a recording and the first of its repetition: a sample of an IMU of 200 Hz."""

_RANDOM_SPAN_NS = (200_000, 20_000_000)
_ORDER = {"imu": 0, "left": 1, "right": 2}


@dataclass(frozen=True, slots=True)
class Chunking:
    """How the stream is cut into packets: every ``period_ns`` of sensor time, or at random with ``seed``.

    Random packets span 0.2 to 20 ms, differ between the cameras and may part events of equal time.
    """

    period_ns: int = 5_000_000
    seed: int | None = None

    @staticmethod
    def parse(text: str) -> Chunking:
        """``"200hz"``, ``"1000hz"``, ``"60hz"``, ..., ``"random"`` or ``"random:SEED"``. Raises ValueError."""
        kind, _, seed = text.strip().lower().partition(":")
        if kind == "random" and (seed == "" or seed.isdecimal()):
            return Chunking(seed=int(seed or 0))
        if kind.endswith("hz") and kind[:-2].isdecimal() and 1 <= int(kind[:-2]) <= 100_000 and not seed:
            return Chunking(period_ns=NS_PER_S // int(kind[:-2]))
        raise ValueError(f"packets: expected a rate such as 200hz, 'random' or 'random:SEED', got {text!r}")


def packets(
    left: EventSource, right: EventSource, imu: Imu, start_ns: int, end_ns: int, chunking: Chunking
) -> Iterator[EventPacket | ImuPacket]:
    """All packets of a recording, by time; at equal times the IMU first, then left, then right.

    ``start_ns`` and ``end_ns`` are the times of the first and the last sample of any stream. After the last event
    each camera ends with one empty packet. Raises RecordingError where times go backwards or cannot be read.
    """
    streams: list[Iterator[EventPacket | ImuPacket]] = [
        _imu_packets(imu, _edges(start_ns, end_ns, chunking, "imu")),
        _event_packets(left, "left", _edges(start_ns, end_ns, chunking, "left"), end_ns, chunking),
        _event_packets(right, "right", _edges(start_ns, end_ns, chunking, "right"), end_ns, chunking),
    ]
    return heapq.merge(*streams, key=_sort_key)


def repeated(once: Sequence[EventPacket | ImuPacket], times: float) -> Iterator[EventPacket | ImuPacket]:
    """The packets of a recording, again and again as one stream of ``times`` rounds (inf: endless).

    Sensor time and ``seq`` go on from round to round; what the sensors see leaps back to the beginning.
    """
    start_ns = min(int(p.sample_t_ns[0]) if isinstance(p, ImuPacket) else p.t_ns for p in once)
    # The empty packets at the end hold for a time that belongs to the next round.
    end_ns = max(p.t_ns for p in once) - FINAL_WATERMARK_NS
    body = [p for p in once if p.t_ns <= end_ns + 1]
    sent = {stream: sum(_stream(p) == stream for p in body) for stream in _ORDER}
    n = 0
    while n < times:
        shift_ns = n * (end_ns - start_ns + _SEAM_NS)
        for p in once if n + 1 >= times else body:
            yield _later(p, shift_ns, n * sent[_stream(p)])
        n += 1


def _later(packet: EventPacket | ImuPacket, shift_ns: int, shift_seq: int) -> EventPacket | ImuPacket:
    seq, t_ns = packet.seq + shift_seq, packet.t_ns + shift_ns
    if isinstance(packet, ImuPacket):
        return replace(packet, seq=seq, t_ns=t_ns, sample_t_ns=packet.sample_t_ns + shift_ns)
    return replace(packet, seq=seq, t_ns=t_ns, event_t_ns=packet.event_t_ns + shift_ns)


def _stream(packet: EventPacket | ImuPacket) -> str:
    return packet.camera if isinstance(packet, EventPacket) else "imu"


def _sort_key(packet: EventPacket | ImuPacket) -> tuple[int, int]:
    return packet.t_ns, _ORDER[_stream(packet)]


def _edges(start_ns: int, end_ns: int, chunking: Chunking, stream: str) -> Iterator[int]:
    """Exclusive ends of consecutive packets; the last is one after ``end_ns``, however the stream is cut."""
    rng = None if chunking.seed is None else np.random.default_rng((chunking.seed, _ORDER[stream]))
    edge = start_ns - start_ns % chunking.period_ns
    while edge <= end_ns:
        edge += chunking.period_ns if rng is None else int(rng.integers(*_RANDOM_SPAN_NS))
        yield min(edge, end_ns + 1)


def _imu_packets(imu: Imu, edges: Iterator[int]) -> Iterator[ImuPacket]:
    seq = start = 0
    for edge in edges:
        stop = int(np.searchsorted(imu.t_ns, edge))
        if stop > start:
            part = slice(start, stop)
            yield ImuPacket(seq, int(imu.t_ns[stop - 1]), imu.t_ns[part], imu.accel[part], imu.gyro[part])
            seq, start = seq + 1, stop


def _event_packets(
    source: EventSource, camera: str, edges: Iterator[int], end_ns: int, chunking: Chunking
) -> Iterator[EventPacket]:
    rng = None if chunking.seed is None else np.random.default_rng((chunking.seed, 10 + _ORDER[camera]))
    cursor = _Cursor(source)
    seq = 0
    for edge in edges:
        events = cursor.take_before(edge)
        n = len(events.t_ns)
        # Cut between events, even of equal time: the watermark then is the last event's own time.
        cut = int(rng.integers(n)) if rng is not None and n > 0 else 0
        if cut > 0:
            yield _packet(seq, int(events.t_ns[cut - 1]), camera, events, slice(0, cut))
            seq += 1
        yield _packet(seq, edge, camera, events, slice(cut, n))
        seq += 1
    yield _packet(seq, end_ns + FINAL_WATERMARK_NS, camera, NO_EVENTS, slice(0, 0))


def _packet(seq: int, t_ns: int, camera: str, events: EventColumns, part: slice) -> EventPacket:
    return EventPacket(seq, t_ns, camera, events.x[part], events.y[part], events.t_ns[part], events.p[part])


class _Cursor:
    """Walks through a source's blocks and hands out the events before a time."""

    def __init__(self, source: EventSource) -> None:
        self._name = source.name
        self._blocks = source.blocks()
        self._have = NO_EVENTS
        self._last_ns: int | None = None

    def take_before(self, t_ns: int) -> EventColumns:
        parts = []
        while True:
            stop = int(np.searchsorted(self._have.t_ns, t_ns))
            parts.append(_slice(self._have, 0, stop))
            if stop < len(self._have.t_ns):
                self._have = _slice(self._have, stop, None)
                break
            block = next(self._blocks, None)
            if block is None:
                self._have = NO_EVENTS
                break
            self._check_order(block)
            self._have = block
        return _concatenate(parts)

    def _check_order(self, block: EventColumns) -> None:
        if len(block.t_ns) == 0:
            return
        before = self._last_ns if self._last_ns is not None else int(block.t_ns[0])
        step = np.diff(block.t_ns, prepend=before)
        if step.min() < 0:
            i = int(np.argmax(step < 0))
            raise RecordingError(
                f"{self._name}: event times go backwards by {-step[i] / 1e3:g} us at t = {block.t_ns[i] / 1e9:.6f} s"
            )
        self._last_ns = int(block.t_ns[-1])


def _slice(events: EventColumns, start: int, stop: int | None) -> EventColumns:
    part = slice(start, stop)
    return EventColumns(events.t_ns[part], events.x[part], events.y[part], events.p[part])


def _concatenate(parts: list[EventColumns]) -> EventColumns:
    parts = [part for part in parts if len(part.t_ns) > 0]
    if not parts:
        return NO_EVENTS
    if len(parts) == 1:
        return parts[0]
    return EventColumns(
        np.concatenate([part.t_ns for part in parts]),
        np.concatenate([part.x for part in parts]),
        np.concatenate([part.y for part in parts]),
        np.concatenate([part.p for part in parts]),
    )
