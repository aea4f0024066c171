"""The events of one camera: checked, filtered, queued until their batch is known, entered into the surfaces."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numba import njit

from velod.config import IngestSettings
from velod.events.columns import readonly
from velod.events.sae import NEVER, update_sae
from velod.events.surface_clock import SurfaceClock
from velod.ingest.budget import BAND_ROWS
from velod.ingest.drops import count_drops
from velod.ingest.ordering import PacketOrder
from velod.types import I32, I64, NS_PER_S, U8, U16, EventPacket

DROPS = ("events.outside", "events.polarity", "events.backwards", "events.hot", "events.background", "shed.events")
_OUTSIDE, _POLARITY, _BACKWARDS, _HOT, _BACKGROUND, _SHED = range(6)

MAX_QUEUED = 1 << 22
"""Events of one camera that wait for their batch: 200 ms (``max_skew_ms``) of 20 Mev/s. More means broken times."""


class EventQueue:
    """A first-in, first-out buffer of event columns; it grows, and its owner keeps it within bounds."""

    def __init__(self) -> None:
        self._head = 0
        self._tail = 0
        self._allocate(1 << 16)

    def __len__(self) -> int:
        return self._tail - self._head

    def _allocate(self, capacity: int) -> None:
        self._x = np.empty(capacity, np.uint16)
        self._y = np.empty(capacity, np.uint16)
        self._t_ns = np.empty(capacity, np.int64)
        self._p = np.empty(capacity, np.uint8)

    def reserve(self, n: int) -> tuple[U16, U16, I64, U8]:
        """Columns with room for ``n`` events behind the last one; ``commit`` says how many were written."""
        if self._tail + n > len(self._t_ns):
            old = self.peek()
            if 2 * (len(self) + n) > len(self._t_ns):
                self._allocate(4 * (len(self) + n))
            self._head, self._tail = 0, len(old[0])
            # Old and new may overlap; numpy copies as if they did not.
            self._x[: self._tail], self._y[: self._tail], self._t_ns[: self._tail], self._p[: self._tail] = old
        room = slice(self._tail, self._tail + n)
        return self._x[room], self._y[room], self._t_ns[room], self._p[room]

    def commit(self, n: int) -> None:
        """The first ``n`` places of ``reserve`` hold events now."""
        self._tail += n

    def peek(self) -> tuple[U16, U16, I64, U8]:
        """The queued x, y, t_ns, p."""
        queued = slice(self._head, self._tail)
        return self._x[queued], self._y[queued], self._t_ns[queued], self._p[queued]

    def drop(self, n: int) -> None:
        """Forget the ``n`` oldest events."""
        self._head += n


class CameraStream:
    """Surfaces, their clock and queue of one camera; every event of it earlier than ``watermark_ns`` is known."""

    def __init__(self, settings: IngestSettings, width: int, height: int, counters: Counter[str]) -> None:
        self.order: PacketOrder[EventPacket] = PacketOrder(counters)
        self.clock = SurfaceClock(height, width)
        self.first = self.clock.new_surface()
        self.last = self.clock.new_surface()
        self.queue = EventQueue()
        self.watermark_ns = NEVER
        self._counters = counters
        self.refractory_ns = round(settings.refractory_ms * 1e6)
        self._background_ns = round(settings.background_ms * 1e6)
        self._hot_count = float(settings.hot_pixel_hz)
        self._filtered = self._background_ns > 0 or self._hot_count > 0
        shape = (height, width) if self._filtered else (1, 1)
        self._seen_ns = np.full(shape, NEVER, np.int64)
        self._second = np.zeros(shape, np.int64)
        self._fired = np.zeros((*shape, 2), np.int32)
        self._width, self._height = width, height

    def accept(self, packet: EventPacket, band_rows: int = BAND_ROWS) -> None:
        """Queue the packet's good events, count the others by cause, move the watermark.

        Of each BAND_ROWS rows the events of the first ``band_rows`` are looked at.
        """
        n = len(packet.event_t_ns)
        dropped = np.zeros(len(DROPS), np.int64)
        x, y, t_ns, p = self.queue.reserve(n)
        kept = _check(
            readonly(packet.x, np.uint16), readonly(packet.y, np.uint16),
            readonly(packet.event_t_ns, np.int64), readonly(packet.p, np.uint8),
            self._width, self._height, self.watermark_ns, band_rows, x, y, t_ns, p, dropped,
        )  # fmt: skip
        if kept:
            self.watermark_ns = int(t_ns[kept - 1])
        if self._filtered:
            kept = _filter(
                x, y, t_ns, p, kept, self._background_ns, self._hot_count,
                self._seen_ns, self._second, self._fired, dropped,
            )  # fmt: skip
        self.queue.commit(kept)
        if kept:
            self._counters["events"] += kept
        self._bound_queue()
        self.watermark_ns = max(self.watermark_ns, packet.t_ns)
        count_drops(self._counters, DROPS, dropped)

    def _bound_queue(self) -> None:
        """Drop the oldest events where times do not go on and so no batch ends."""
        if (excess := len(self.queue) - MAX_QUEUED) > 0:
            self.queue.drop(excess)
            self._counters["events.overflow"] += excess

    def take_before(self, t_ns: int) -> tuple[U16, U16, I64, U8]:
        """Columns x, y, t_ns, p of the queued events earlier than ``t_ns``, which leave the queue."""
        x, y, t, p = self.queue.peek()
        n = int(np.searchsorted(t, t_ns, side="left"))
        self.queue.drop(n)
        return x[:n], y[:n], t[:n], p[:n]

    def enter_before(self, t_ns: int) -> I64:
        """Move the queued events earlier than ``t_ns`` into the surfaces; returns their times."""
        x, y, t, p = self.take_before(t_ns)
        for part in self.clock.spans(t):
            update_sae(
                x[part], y[part], t[part], p[part], self.first, self.last, self.refractory_ns, self.clock.epoch_ns
            )
        return t


@njit(cache=True, nogil=True)
def _check(
    x: U16,
    y: U16,
    t_ns: I64,
    p: U8,
    width: int,
    height: int,
    not_before_ns: int,
    band_rows: int,
    out_x: U16,
    out_y: U16,
    out_t_ns: I64,
    out_p: U8,
    dropped: I64,
) -> int:
    """Copy the events that are on the sensor, of polarity 0 or 1, in time order, in a kept row; returns how many."""
    if band_rows >= BAND_ROWS and _copy_good(
        x, y, t_ns, p, width, height, not_before_ns, out_x, out_y, out_t_ns, out_p
    ):
        return t_ns.size
    n = 0
    for i in range(t_ns.size):
        if x[i] >= width or y[i] >= height:
            dropped[_OUTSIDE] += 1
        elif p[i] > 1:
            dropped[_POLARITY] += 1
        elif t_ns[i] < not_before_ns:
            dropped[_BACKWARDS] += 1
        else:
            not_before_ns = t_ns[i]
            if y[i] % BAND_ROWS >= band_rows:
                dropped[_SHED] += 1
                continue
            out_x[n], out_y[n], out_t_ns[n], out_p[n] = x[i], y[i], t_ns[i], p[i]
            n += 1
    return n


@njit(cache=True, nogil=True)
def _copy_good(
    x: U16,
    y: U16,
    t_ns: I64,
    p: U8,
    width: int,
    height: int,
    not_before_ns: int,
    out_x: U16,
    out_y: U16,
    out_t_ns: I64,
    out_p: U8,
) -> bool:
    """Copy all events; whether there is nothing to drop, as nearly always. Loops that vectorise, a column each."""
    if t_ns.size == 0:
        return True
    last_x, last_y, highest_p, backwards = np.uint16(0), np.uint16(0), np.uint8(0), False
    for i in range(x.size):
        out_x[i] = x[i]
        last_x = max(last_x, x[i])
    for i in range(y.size):
        out_y[i] = y[i]
        last_y = max(last_y, y[i])
    for i in range(p.size):
        out_p[i] = p[i]
        highest_p = max(highest_p, p[i])
    out_t_ns[0] = t_ns[0]
    for i in range(1, t_ns.size):
        out_t_ns[i] = t_ns[i]
        backwards |= t_ns[i] < t_ns[i - 1]
    return bool(last_x < width and last_y < height and highest_p < 2 and not backwards and t_ns[0] >= not_before_ns)


@njit(cache=True, nogil=True)
def _filter(
    x: U16,
    y: U16,
    t_ns: I64,
    p: U8,
    size: int,
    background_ns: int,
    hot_count: float,
    seen_ns: I64,
    second: I64,
    fired: I32,
    dropped: I64,
) -> int:
    """Drop, in place, events of hot pixels and lonely events; returns how many are left. 0 turns a filter off.

    ``seen_ns`` (h, w): last event of the pixel; ``second`` (h, w): second of sensor time that ``fired`` (h, w, 2)
    counts the events of, and of the one before.
    """
    n = 0
    for i in range(size):
        r, c, t = int(y[i]), int(x[i]), t_ns[i]
        seen_ns[r, c] = t
        now = t // NS_PER_S
        if now != second[r, c]:
            fired[r, c, 1] = fired[r, c, 0] if now == second[r, c] + 1 else 0
            fired[r, c, 0] = 0
            second[r, c] = now
        fired[r, c, 0] += 1
        # Events of the last second: all of this one and what of the one before still falls into it.
        overlap = 1.0 - (t - now * NS_PER_S) / NS_PER_S
        if hot_count > 0.0 and fired[r, c, 0] + overlap * fired[r, c, 1] > hot_count:
            dropped[_HOT] += 1
            continue
        if background_ns > 0 and not _has_company(seen_ns, r, c, t - background_ns):
            dropped[_BACKGROUND] += 1
            continue
        x[n], y[n], t_ns[n], p[n] = x[i], y[i], t, p[i]
        n += 1
    return n


@njit(cache=True, nogil=True)
def _has_company(seen_ns: I64, r: int, c: int, since_ns: int) -> bool:
    h, w = seen_ns.shape
    for i in range(max(r - 1, 0), min(r + 2, h)):
        for j in range(max(c - 1, 0), min(c + 2, w)):
            if (i != r or j != c) and seen_ns[i, j] >= since_ns:
                return True
    return False
