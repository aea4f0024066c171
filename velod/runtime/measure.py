"""What a process measures of itself: latency percentiles and holes in sequence numbers."""

from __future__ import annotations

import numpy as np


class LatencyRing:
    """The newest samples of a latency, at most ``capacity``; percentiles on demand."""

    def __init__(self, capacity: int = 4096) -> None:
        self._ms = np.zeros(capacity)
        self._n = 0

    def add(self, ns: int) -> None:
        """One sample, in nanoseconds."""
        self._ms[self._n % len(self._ms)] = ns * 1e-6
        self._n += 1

    def percentiles(self) -> tuple[float, float] | None:
        """p50 and p99 in ms; None without a sample."""
        held = self._ms[: min(self._n, len(self._ms))]
        if not len(held):
            return None
        p50, p99 = np.percentile(held, (50, 99))
        return float(p50), float(p99)

    def clear(self) -> None:
        """Begin a new period."""
        self._n = 0


class GapCounter:
    """Counts the messages that one stream lost, by their ``seq``.

    ``window`` is how far messages may overtake each other (several workers publish on one key); a missing one is
    counted once it is further back than that. A ``seq`` further back than any overtaking explains, or a 0 where 0
    was already, is a publisher that started anew.
    """

    def __init__(self, window: int = 0) -> None:
        self.lost = 0
        self.restarts = 0
        self._window = window
        self._next = -1
        self._missing: set[int] = set()

    def see(self, seq: int) -> None:
        """A message arrived."""
        if self._next < 0 or self._started_anew(seq):
            self._missing.clear()
            self._next = seq + 1
            return
        if seq < self._next:
            self._missing.discard(seq)
            return
        self._missing.update(range(max(self._next, seq - self._window), seq))
        self.lost += max(0, seq - self._window - self._next)
        self._next = seq + 1
        given_up = [s for s in self._missing if s < seq - self._window]
        self.lost += len(given_up)
        self._missing.difference_update(given_up)

    def _started_anew(self, seq: int) -> bool:
        again = seq < self._next - self._window - 1 or (seq == 0 and self._next > 0 and seq not in self._missing)
        self.restarts += again
        return again
