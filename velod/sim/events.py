"""ESIM's event model: thresholds on log intensity, which runs linearly between two rendered views.

Rebecq, Gehrig, Scaramuzza, "ESIM: an Open Event Camera Simulator", CoRL 2018.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from velod.io.model import EventColumns
from velod.sim.effects import Effects, Noise, SensorError, merged
from velod.sim.kernels import SAME_BITS
from velod.types import F32, I64, U8, U16

LOG_EPS = 1e-3
"""Added to the intensity before the logarithm."""

_LOG_RANGE = float(np.log((1.0 + LOG_EPS) / LOG_EPS))


@dataclass(frozen=True, slots=True)
class EventModel:
    """How a pixel fires."""

    threshold: float = 0.5  # C, contrast in log intensity
    threshold_sigma: float = 0.021  # spread of C from pixel to pixel and between the polarities
    refractory_us: int = 100  # a pixel is blind so long after an event

    def __post_init__(self) -> None:
        """Raises SensorError."""
        if not (self.threshold > 0.0 and 0.0 <= self.threshold_sigma < float("inf") and self.refractory_us >= 0):
            raise SensorError(f"contrasts must be positive, spread and refractory period not negative: {self}")


class EventSensor:
    """The pixels of one camera. Views come area by area, each with its own time; events go out in time order."""

    def __init__(
        self, model: EventModel, effects: Effects, width: int, height: int, rng: np.random.Generator
    ) -> None:
        spread = rng.normal(model.threshold, model.threshold_sigma, (2, height, width))
        # A threshold far below the others would fire on nothing at all.
        self._threshold = np.maximum(spread, 0.1 * model.threshold).astype(np.float32)
        self._refractory_us = model.refractory_us
        self._log = np.zeros((height, width), np.float32)
        self._reference = np.zeros((height, width), np.float32)
        self._last_us = np.full((height, width), -(1 << 40), np.int64)
        self._per_pixel = int(_LOG_RANGE / float(self._threshold.min())) + 1
        self._row = np.empty(width, np.float32)
        self._leak_hz, self._bandwidth_hz = float(effects.leak_hz), float(effects.bandwidth_hz)
        self._noise = Noise(effects, width, height, rng)
        self._count = 0
        self._t_us: I64 = np.empty(0, np.int64)
        self._x: U16 = np.empty(0, np.uint16)
        self._y: U16 = np.empty(0, np.uint16)
        self._p: U8 = np.empty(0, np.uint8)

    def start(self, intensity: F32) -> None:
        """The view that the pixels have adapted to; gives no events."""
        self._log[...] = np.log(np.float32(LOG_EPS) + intensity)
        self._reference[...] = self._log

    def see(self, intensity: F32, areas: I64, from_us: I64, to_us: int) -> None:
        """``areas`` (m, 4) of ``intensity`` are as seen at ``to_us``; they were last seen at ``from_us`` (m,)."""
        self._make_room(intensity.size * self._per_pixel)
        self._count = _emit(
            intensity,
            areas,
            from_us,
            to_us,
            self._row,
            self._log,
            self._reference,
            self._threshold,
            self._last_us,
            self._refractory_us,
            self._leak_hz,
            self._bandwidth_hz,
            self._t_us,
            self._x,
            self._y,
            self._p,
            self._count,
        )

    def take(self, from_us: int, to_us: int) -> EventColumns:
        """The events since the last call, all of ``from_us <= t <= to_us``; ties in the order in which they arose."""
        n = self._count
        self._count = 0
        order = _time_order(self._t_us[:n], from_us, to_us)
        seen = EventColumns(self._t_us[order] * 1000, self._x[order], self._y[order], self._p[order])
        return merged(seen, self._noise.between(from_us, to_us))

    def _make_room(self, n: int) -> None:
        if len(self._t_us) - self._count >= n:
            return
        size = self._count + 2 * n
        self._t_us, self._x, self._y, self._p = (
            np.concatenate([column[: self._count], np.empty(size - self._count, column.dtype)])
            for column in (self._t_us, self._x, self._y, self._p)
        )


@njit(cache=True, nogil=True)
def _emit(
    intensity: F32,
    areas: I64,
    from_us: I64,
    to_us: int,
    row: F32,
    log: F32,
    reference: F32,
    threshold: F32,
    last_us: I64,
    refractory_us: int,
    leak_hz: float,
    bandwidth_hz: float,
    t_us: I64,
    x: U16,
    y: U16,
    p: U8,
    count: int,
) -> int:
    """Cross the thresholds of every pixel in ``areas``; returns the new count. ``row`` is room to work in."""
    for m in range(areas.shape[0]):
        start_us, i0, i1 = from_us[m], areas[m, 2], areas[m, 3]
        span_us = np.float64(to_us - start_us)
        for j in range(areas[m, 0], areas[m, 1]):
            now = row[: i1 - i0]
            _log_row(intensity[j, i0:i1], now)
            if bandwidth_hz > 0.0:
                _follow(now, log[j, i0:i1], intensity[j, i0:i1], bandwidth_hz * span_us * 1e-6)
            for i in range(i0, i1):
                # The reference sinks; to the comparison that is the same as an intensity that rises.
                leak = np.float32(leak_hz * span_us * 1e-6) * threshold[1, j, i] if leak_hz > 0.0 else np.float32(0.0)
                before, after = log[j, i], now[i - i0] + leak
                if after == before:
                    continue
                log[j, i] = now[i - i0]
                level = reference[j, i]
                polarity = 1 if after > level else 0
                step = threshold[polarity, j, i] if polarity == 1 else -threshold[polarity, j, i]
                # after - level and step have the same sign.
                while abs(after - level) >= abs(step):
                    level += step
                    t = start_us + np.int64(np.rint(span_us * ((level - before) / (after - before))))
                    if t - last_us[j, i] >= refractory_us:
                        last_us[j, i] = t
                        t_us[count], x[count], y[count], p[count] = t, i, j, polarity
                        count += 1
                reference[j, i] = level - leak
    return count


@njit(cache=True, nogil=True, fastmath=SAME_BITS, error_model="numpy")
def _log_row(intensity: F32, out: F32) -> None:
    """log(eps + intensity) to 2e-6, several times as fast as the library's: LLVM vectorises it."""
    one, third, fifth, seventh = np.float32(1.0), np.float32(1.0 / 3.0), np.float32(0.2), np.float32(1.0 / 7.0)
    two, ln_2, root_2 = np.float32(2.0), np.float32(np.log(2.0)), 0x3FB504F3
    for i in range(intensity.shape[0]):
        bits = np.float32(np.float32(LOG_EPS) + intensity[i]).view(np.int32)
        # x = 2^e m with m between sqrt(1/2) and sqrt(2); log m = 2 artanh((m - 1) / (m + 1))
        e = (bits - root_2 + 0x00800000) >> 23
        m = np.int32(bits - (e << 23)).view(np.float32)
        s = (m - one) / (m + one)
        q = s * s
        out[i] = np.float32(e) * ln_2 + two * s * (one + q * (third + q * (fifth + q * seventh)))


@njit(cache=True, nogil=True)
def _follow(now: F32, before: F32, intensity: F32, corner_turns: float) -> None:
    """Low-pass ``now``, the log intensity after an interval of ``corner_turns`` = bandwidth * time.

    The corner is in proportion to the photocurrent, with a dark current of 1/12 (Hu, Liu, Delbruck, "v2e", 2021).
    """
    for i in range(now.shape[0]):
        light = (intensity[i] + 1.0 / 12.0) / (1.0 + 1.0 / 12.0)
        now[i] = before[i] + (now[i] - before[i]) * (1.0 - np.exp(-2.0 * np.pi * corner_turns * light))


@njit(cache=True, nogil=True)
def _time_order(t_us: I64, from_us: int, to_us: int) -> I64:
    """Counting sort: the stable order of times within [from_us, to_us]."""
    place = np.zeros(to_us - from_us + 2, np.int64)
    for k in range(t_us.shape[0]):
        place[t_us[k] - from_us + 1] += 1
    for b in range(1, place.shape[0]):
        place[b] += place[b - 1]
    order = np.empty(t_us.shape[0], np.int64)
    for k in range(t_us.shape[0]):
        b = t_us[k] - from_us
        order[place[b]] = k
        place[b] += 1
    return order
