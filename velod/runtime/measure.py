"""What a process measures of itself: latency percentiles, the age of data, and holes in sequence numbers."""

from __future__ import annotations

import math

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


class SensorClock:
    """Takes sensor time to host time, by the least delay with which data of the sensor arrives.

    That least delay counts as none: what it hides is the way from the sensor to velod on an idle system. Host clocks
    of several hosts must be synchronised.
    """

    _DRIFT = 1e-4
    """The clocks may part this fast: crystals are good to 50 ppm each."""
    _RESTART_NS = 10_000_000_000
    """Data this late is not late: the sensor's clock was set anew."""

    def __init__(self) -> None:
        self._offset_ns: int | None = None  # host less sensor
        self._t_ns = 0

    def heard(self, t_ns: int, host_ns: int) -> None:
        """Data of sensor time ``t_ns`` had arrived at ``host_ns``."""
        offset_ns = host_ns - t_ns
        if self._offset_ns is not None and offset_ns - self._offset_ns < self._RESTART_NS:
            # Data that took another way may be of an earlier moment.
            t_ns = max(t_ns, self._t_ns)
            offset_ns = min(offset_ns, self._offset_ns + int((t_ns - self._t_ns) * self._DRIFT))
        self._offset_ns, self._t_ns = offset_ns, t_ns

    def age_ms(self, t_ns: int, host_ns: int) -> float:
        """How long before ``host_ns`` sensor time ``t_ns`` was; NaN before anything was heard."""
        return math.nan if self._offset_ns is None else (host_ns - self._offset_ns - t_ns) * 1e-6


class HostClocks:
    """Whether another host's clock agrees with this one's, by the times between sending and receiving.

    A message cannot arrive before it was sent: one that does shows that the other clock is ahead. A clock that is
    ahead by less than messages take shows nothing, and makes them look younger by no more than that. One that is
    behind makes them look older than they are, which does no harm.
    """

    TOLERANCE_NS = 1_000_000
    DOUBT_NS = 10_000_000_000
    """Once caught, a clock is not trusted for so long."""

    def __init__(self) -> None:
        self._caught_ns: int | None = None

    def heard(self, t_sent_ns: int, t_received_ns: int) -> None:
        """One message, by the clocks of its sender and of this host."""
        if t_received_ns < t_sent_ns - self.TOLERANCE_NS:
            self._caught_ns = t_received_ns

    def agree(self, now_ns: int) -> bool:
        """Whether nothing speaks against it."""
        return self._caught_ns is None or now_ns > self._caught_ns + self.DOUBT_NS


class GapCounter:
    """Counts the messages that one stream lost, by their ``seq``.

    ``window`` is how far messages may overtake each other (several workers publish on one key); a missing one is
    counted once it is further back than that. In an ordered stream (``window`` 0) a lower ``seq`` is a publisher that
    started anew. In others it may be a straggler, so somebody who knows has to call ``forget``.
    """

    def __init__(self, window: int = 0) -> None:
        self.window = window
        self.lost = 0
        self.restarts = 0
        self._next = -1
        self._missing: set[int] = set()

    def see(self, seq: int) -> None:
        """A message arrived."""
        if self._next < 0 or (seq == self._next and not self._missing):
            self._next = seq + 1
        elif seq >= self._next:
            self._advance(seq)
        elif self.window:
            self._missing.discard(seq)
        else:
            self.restarts += 1
            self._next = seq + 1

    def forget(self) -> None:
        """The next message is the first one of a new stream."""
        self._next = -1
        self._missing.clear()

    def _advance(self, seq: int) -> None:
        oldest = seq - self.window
        given_up = {s for s in self._missing if s < oldest}
        self._missing -= given_up
        self._missing.update(range(max(self._next, oldest), seq))
        self.lost += len(given_up) + max(0, oldest - self._next)
        self._next = seq + 1
