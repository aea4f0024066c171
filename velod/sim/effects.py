"""What real sensors do to events, beside ESIM's model. All is off unless asked for.

Inside the pixel (bandwidth, leak) it changes when thresholds are crossed (velod.sim.events); noise and hot pixels add
events; the readout (bus, clock) delays, drops and stamps them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from velod.io.model import NO_EVENTS, EventColumns
from velod.types import F64, I64

HOT_HZ = 500.0
"""Mean rate of a hot pixel."""

BUS_BUFFER_US = 1000
"""A readout holds back as many events as its bus takes in this time; what comes on top is lost."""

_JITTER_SIGMAS = 4.0  # no stamp is further off: so it is known when no earlier one can come


@dataclass(frozen=True, slots=True)
class Effects:
    """Strengths of the effects; 0 is off."""

    noise_hz: float = 0.0  # background events of each pixel, either polarity
    hot_share: float = 0.0  # of the pixels, each with HOT_HZ
    leak_hz: float = 0.0  # ON events of a pixel that sees nothing change
    bandwidth_hz: float = 0.0  # corner of a pixel's low-pass at intensity 1, in proportion to the intensity
    jitter_us: float = 0.0  # standard deviation of a stamp
    quantum_us: int = 0  # stamps are multiples of it, rounded down
    bus_mev_s: float = 0.0  # 1e6 events/s that a camera can read out
    radtan: tuple[float, ...] = ()  # k1 k2 p1 p2 k3 of both lenses
    clock_offset_us: int = 0  # of the right camera: its stamps are so much later

    def __post_init__(self) -> None:
        """Raises SensorError."""
        for name in ("noise_hz", "hot_share", "leak_hz", "bandwidth_hz", "jitter_us", "quantum_us", "bus_mev_s"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise SensorError(f"{name} must be zero or more and finite, got {getattr(self, name):g}")
        if self.hot_share > 1.0:
            raise SensorError(f"hot_share must be at most 1, got {self.hot_share:g}")
        if len(self.radtan) not in (0, 5) or not all(math.isfinite(k) for k in self.radtan):
            raise SensorError(f"radtan must be five finite numbers k1 k2 p1 p2 k3, got {self.radtan}")


class SensorError(ValueError):
    """What no sensor can do; the text names it."""


class Noise:
    """Events that nothing in the scene causes: background, and hot pixels. Poisson, all independent."""

    def __init__(self, effects: Effects, width: int, height: int, rng: np.random.Generator) -> None:
        self._rng = rng
        rate = np.full(width * height, effects.noise_hz, np.float64)
        if effects.hot_share > 0.0:
            rate[rng.choice(rate.size, round(effects.hot_share * rate.size), replace=False)] += HOT_HZ
        self._cumulative_hz: F64 = np.cumsum(rate)
        self._width = width

    def between(self, from_us: int, to_us: int) -> EventColumns:
        """The events of ``from_us < t <= to_us``, in time order."""
        total_hz = float(self._cumulative_hz[-1])
        if total_hz == 0.0:
            return NO_EVENTS
        n = int(self._rng.poisson(total_hz * (to_us - from_us) * 1e-6))
        t_us = np.sort(self._rng.integers(from_us, to_us, n, endpoint=False)) + 1
        pixel = np.searchsorted(self._cumulative_hz, self._rng.random(n) * total_hz, side="right")
        y, x = np.divmod(pixel, self._width)
        return EventColumns(
            t_us * 1000, x.astype(np.uint16), y.astype(np.uint16), self._rng.integers(0, 2, n, dtype=np.uint8)
        )


class Readout:
    """A camera's bus and clock. Batches go in and come out in time order; some events wait for the next batch."""

    def __init__(self, effects: Effects, clock_offset_us: int, rng: np.random.Generator) -> None:
        self._effects, self._offset_us, self._rng = effects, clock_offset_us, rng
        self._free_ns = np.full(1, -(1 << 62), np.int64)  # when the bus has read out what came before
        self._waiting = NO_EVENTS

    def read(self, events: EventColumns, until_us: int | None) -> EventColumns:
        """What can be stamped for good after ``events``, the last of them up to ``until_us``; None: the rest."""
        effects = self._effects
        events = self._through_bus(events)
        t_us = events.t_ns // 1000 + self._offset_us
        late_us = 0
        if effects.jitter_us > 0.0:
            noise = np.clip(self._rng.normal(size=len(t_us)), -_JITTER_SIGMAS, _JITTER_SIGMAS)
            t_us = t_us + np.rint(effects.jitter_us * noise).astype(np.int64)
            late_us = math.ceil(_JITTER_SIGMAS * effects.jitter_us)
        if effects.quantum_us > 0:
            t_us = t_us - t_us % effects.quantum_us
            late_us += effects.quantum_us
        stamped = _joined(self._waiting, EventColumns(t_us * 1000, events.x, events.y, events.p))
        if late_us > 0:
            stamped = _taken(stamped, np.argsort(stamped.t_ns, kind="stable"))
        # A stamp of the next batch may be so much earlier.
        limit_ns = (1 << 62) if until_us is None else (until_us + self._offset_us - late_us) * 1000
        n = int(np.searchsorted(stamped.t_ns, limit_ns, side="right")) if late_us > 0 else len(stamped.t_ns)
        self._waiting = _taken(stamped, np.arange(n, len(stamped.t_ns)))
        # A clock that is behind has not started yet.
        return _taken(stamped, np.arange(int(np.searchsorted(stamped.t_ns[:n], 0)), n))

    def _through_bus(self, events: EventColumns) -> EventColumns:
        if self._effects.bus_mev_s == 0.0:
            return events
        t_ns = events.t_ns.copy()
        kept = _queue(t_ns, self._free_ns, 1e3 / self._effects.bus_mev_s, BUS_BUFFER_US * 1000)
        return _taken(EventColumns(t_ns, events.x, events.y, events.p), kept)


def merged(a: EventColumns, b: EventColumns) -> EventColumns:
    """Both in time order; ``a`` first where times are equal."""
    if len(b.t_ns) == 0:
        return a
    both = _joined(a, b)
    return _taken(both, np.argsort(both.t_ns, kind="stable"))


def _joined(a: EventColumns, b: EventColumns) -> EventColumns:
    if len(a.t_ns) == 0:
        return b
    return EventColumns(
        np.concatenate([a.t_ns, b.t_ns]),
        np.concatenate([a.x, b.x]),
        np.concatenate([a.y, b.y]),
        np.concatenate([a.p, b.p]),
    )


def _taken(events: EventColumns, rows: I64) -> EventColumns:
    return EventColumns(events.t_ns[rows], events.x[rows], events.y[rows], events.p[rows])


@njit(cache=True, nogil=True)
def _queue(t_ns: I64, free_ns: I64, service_ns: float, buffer_ns: int) -> I64:
    """Put each event's time to when it has been read out; returns the rows of those that were not lost."""
    kept = np.empty(t_ns.shape[0], np.int64)
    n = 0
    for k in range(t_ns.shape[0]):
        done = max(t_ns[k], free_ns[0]) + np.int64(np.rint(service_ns))
        if done - t_ns[k] <= buffer_ns:
            t_ns[k], free_ns[0], kept[n] = done, done, k
            n += 1
    return kept[:n]
