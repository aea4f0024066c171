"""Event-by-event mode: what has been selected of the open batch, and the slices in which it goes out.

A slice ends at each whole multiple of ``slice_ms`` in sensor time and at the end of its batch, so slices depend on
the left stream alone. They are EventBatches; the StereoBatch at the batch's end carries the same events.
"""

from __future__ import annotations

import numpy as np

from velod.config import Settings
from velod.events.causal import all_open, enter_and_select, split_ages
from velod.events.plane_fit import SIZE, WIDE_SIZE
from velod.events.sae import NEVER
from velod.events.selection import cell_side_px
from velod.ingest.batch import OpenBatch
from velod.ingest.budget import Budget
from velod.ingest.stream import CameraStream
from velod.types import RING, U8, U16, U32, EventBatch

MAX_SELECTED = 65_535
"""Events that one batch can carry (uint16 positions); a batch that is full selects no more."""
MAX_AGE_NS = 2**32 - 1
MIDDLE = WIDE_SIZE // 2
"""Where in a 7x7 the event is."""


class Slices:
    """Selects from the left stream event by event, and cuts what is selected into EventBatches."""

    def __init__(self, settings: Settings, width: int, height: int) -> None:
        s = settings.ingest
        self._settings = settings
        self._slice_ns = round(s.slice_ms * 1e6)
        self._memory_ns = round(s.memory_ms * 1e6)
        cell_px = cell_side_px(height, width, s.quota)
        self._row_cell, self._column_cell = np.arange(height) // cell_px, np.arange(width) // cell_px
        # Pages that are never written to cost nothing.
        self._at = np.empty((MAX_SELECTED, 3), np.int32)
        self._times_ns = np.empty((MAX_SELECTED, WIDE_SIZE), np.int64)
        self._seq = -1
        self._time_noise_ns = 0
        self._sent = 0

    def begin_epoch(self, left: CameraStream) -> None:
        """The sensor's clock has been set anew, or for the first time: nothing is selected, every cell is open."""
        self._left = left
        self._taken = left.clock.new_surface()
        self._open_ns = all_open(int(self._row_cell[-1]) + 1, int(self._column_cell[-1]) + 1)
        self._end_ns: int | None = None  # of the slice that has begun
        self._n_events = 0  # that went in since the last slice came out
        self._t_start_ns = NEVER  # of the batch; NEVER: it has not begun
        self.begin_batch()

    def begin_batch(self) -> int:
        """Forget what was selected; returns when the batch began of which it was."""
        self._n = self._sent = 0
        t_start_ns, self._t_start_ns = self._t_start_ns, NEVER
        return t_start_ns

    @property
    def has_sent(self) -> bool:
        """Whether a part of the open batch is on its way."""
        return self._sent > 0

    def advance(
        self,
        batch: OpenBatch,
        batch_seq: int,
        horizon_ns: int,
        budget: Budget,
        time_noise_ns: int,
    ) -> list[EventBatch]:
        """Enter the left events before ``horizon_ns``, all of them of ``batch``; returns the slices that are over.

        With a share of the selection cells rest longer, and without ``budget.slices`` what is selected waits for a
        later slice, at the latest that at the batch's end. Time stamps have an error of ``time_noise_ns``.
        """
        self._time_noise_ns = time_noise_ns
        out: list[EventBatch] = []
        rest_ns = round(self._settings.ingest.rest_ms * 1e6 / budget.selection)
        while True:
            if self._end_ns is None:
                queued_t_ns = self._left.queue.peek()[2]
                if not len(queued_t_ns) or queued_t_ns[0] >= horizon_ns:
                    break
                self._end_ns = (int(queued_t_ns[0]) // self._slice_ns + 1) * self._slice_ns
            self._enter(batch, min(self._end_ns, horizon_ns), rest_ns)
            if horizon_ns < self._end_ns:
                break
            if budget.slices:
                out += self._cut(batch, batch_seq, self._end_ns)
            self._end_ns = None
        if horizon_ns == batch.t_end_ns:
            out += self._cut(batch, batch_seq, horizon_ns)
            self._end_ns = None
        return out

    def rest_of(self, batch: OpenBatch, batch_seq: int, t_end_ns: int) -> list[EventBatch]:
        """A batch of which nothing was selected goes out as one empty slice, so that nobody waits for more."""
        return [] if self._n else [self._slice(batch, batch_seq, t_end_ns)]

    def selected(self, t_end_ns: int) -> tuple[U16, U16, U32, U8]:
        """x, y, age (ns before ``t_end_ns``) and p of all events that were selected since ``begin_batch``."""
        p, y, x = self._at[: self._n].T
        age = np.minimum(t_end_ns - self._times_ns[: self._n, MIDDLE], MAX_AGE_NS)
        return x.astype(np.uint16), y.astype(np.uint16), age.astype(np.uint32), p.astype(np.uint8)

    def patches(self, t_end_ns: int, most: int) -> U32:
        """(n, 25) ages in ns of the 5x5 neighbours of the events that were selected since ``begin_batch``, or of so
        many of them, evenly spread.
        """
        return self._ages(slice(0, self._n, max(1, -(-self._n // most))), t_end_ns)[1]

    def _enter(self, batch: OpenBatch, t_ns: int, rest_ns: int) -> None:
        s, fit, left = self._settings.ingest, self._settings.flow, self._left
        x, y, t, p = left.take_before(t_ns)
        for part in left.clock.spans(t):
            self._n = enter_and_select(
                x[part], y[part], t[part], p[part], left.first, left.last, left.refractory_ns, left.clock.epoch_ns,
                self._taken, self._open_ns, self._row_cell, self._column_cell, rest_ns, s.border_px,
                self._memory_ns, fit.reject_px, fit.rejections, s.min_neighbours, fit.max_rms_px,
                1e-9 * self._time_noise_ns,
                self._at, self._times_ns, self._n,
            )  # fmt: skip
        self._n_events += len(t)
        batch.fill(t)

    def _cut(self, batch: OpenBatch, batch_seq: int, t_end_ns: int) -> list[EventBatch]:
        return [self._slice(batch, batch_seq, t_end_ns)] if self._n > self._sent else []

    def _slice(self, batch: OpenBatch, batch_seq: int, t_end_ns: int) -> EventBatch:
        """What has been selected and not been sent."""
        self._seq += 1
        first, new = self._sent, slice(self._sent, self._n)
        n_events, self._n_events = self._n_events, 0
        self._sent = self._n
        p, y, x = self._at[new].T
        age, patch, ring = self._ages(new, t_end_ns)
        if self._t_start_ns == NEVER:
            assert batch.t_start_ns is not None
            self._t_start_ns = batch.t_start_ns
        return EventBatch(
            self._seq, t_end_ns, self._t_start_ns, n_events,
            x.astype(np.uint16), y.astype(np.uint16), age, p.astype(np.uint8), patch, batch_seq, first, ring,
            self._time_noise_ns,
        )  # fmt: skip

    def _ages(self, which: slice, t_end_ns: int) -> tuple[U32, U32, U32]:
        """age (n,), patch (n, 25) and ring (n, 24) of these of the selected, ns before ``t_end_ns``."""
        times_ns = np.ascontiguousarray(self._times_ns[which])
        n = len(times_ns)
        age, patch, ring = np.empty(n, np.uint32), np.empty((n, SIZE), np.uint32), np.empty((n, RING), np.uint32)
        split_ages(times_ns, t_end_ns, self._memory_ns, age, patch, ring)
        return age, patch, ring
