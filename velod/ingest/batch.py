"""Where one batch of left events ends and the next begins: by count, by time, or by whichever comes first."""

from __future__ import annotations

from velod.config import IngestSettings
from velod.ingest.budget import MOST_HZ
from velod.ticks import spaced_tick_ns
from velod.types import I64

IDLE_NS = 1_000_000_000
"""Time without left events after which empty batches are no longer made, until the next event."""


class OpenBatch:
    """The half-open interval [t_start_ns, t_end_ns) being filled; its end depends on the events alone.

    'count': just after the count-th event, so that events of one time never part; 'time': at the next whole multiple
    of the period in sensor time; 'first': the count, but at most a period after the start. Where batches are
    spaced, one whose count is reached goes on to the next of their times.
    """

    def __init__(self, settings: IngestSettings, output_hz: float) -> None:
        self._output_hz = output_hz
        self._mode = settings.batch
        self._count = settings.count
        self._period_ns = round(settings.period_ms * 1e6)
        self.t_start_ns: int | None = None
        self.t_end_ns: int | None = None
        self.n = 0  # events entered
        self._last_event_ns = 0

    def find_end(self, queued_t_ns: I64, watermark_ns: int, spaced: bool = False) -> None:
        """Set ``t_end_ns`` once the queued left events and their watermark leave no other."""
        if self.t_start_ns is None and len(queued_t_ns):
            self.t_start_ns = int(queued_t_ns[0])
        if self.t_end_ns is not None or self.t_start_ns is None:
            return
        limit = self._time_limit(self.t_start_ns)
        if self._mode != "time" and self.n + len(queued_t_ns) >= self._count:
            end = int(queued_t_ns[self._count - self.n - 1]) + 1
            if spaced:
                end = spaced_tick_ns(end, self._output_hz, MOST_HZ)
            self.t_end_ns = end if limit is None else min(end, limit)
            return
        if limit is not None and watermark_ns >= limit:
            self.t_end_ns = limit

    def _time_limit(self, t_start_ns: int) -> int | None:
        if self._mode == "count":
            return None
        if self._mode == "time":
            return (t_start_ns // self._period_ns + 1) * self._period_ns
        return t_start_ns + self._period_ns

    def fill(self, entered_t_ns: I64) -> None:
        """Note left events that were entered into the surfaces."""
        self.n += len(entered_t_ns)
        if len(entered_t_ns):
            self._last_event_ns = int(entered_t_ns[-1])

    def horizon_ns(self, watermark_ns: int) -> int:
        """Events before it certainly belong to this batch or an earlier one."""
        return watermark_ns if self.t_end_ns is None else self.t_end_ns

    def is_idle(self) -> bool:
        """Whether the batch is empty and events stopped so long ago that none is made of it."""
        return self.n == 0 and self.t_end_ns is not None and self.t_end_ns - self._last_event_ns > IDLE_NS

    def begin_next(self) -> None:
        """The next batch follows at once; after an idle one, with the next event."""
        self.t_start_ns = None if self.is_idle() else self.t_end_ns
        self.t_end_ns = None
        self.n = 0
