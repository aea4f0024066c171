"""The sensor's clock against the host's: offset and drift, from the times at which its data arrive."""

from __future__ import annotations

from collections import deque

import numpy as np

from velod.types import NS_PER_S

SECONDS = 60
"""Of sensor time that the estimate looks back."""
DRIFT_AFTER = 10
"""Seconds before a drift is told: 1 ms of delay is 100 ppm of ten."""


class SensorClockFit:
    """A line through the least delay of each second.

    The least delay of all counts as none: ``offset_s`` includes the way from the sensor to velod on an idle system.
    The slope is the median of those between any two of the seconds, which a few seconds of stalls do not move.
    """

    def __init__(self) -> None:
        self._least: deque[tuple[int, int]] = deque(maxlen=SECONDS)  # of each second: sensor time, host less sensor

    def heard(self, t_ns: int, host_ns: int) -> None:
        """Data of sensor time ``t_ns`` was there at ``host_ns``."""
        offset_ns = host_ns - t_ns
        if self._least:
            newest_t_ns, least_ns = self._least[-1]
            if t_ns // NS_PER_S == newest_t_ns // NS_PER_S:
                if offset_ns < least_ns:
                    self._least[-1] = (t_ns, offset_ns)
                return
            if t_ns < newest_t_ns - NS_PER_S:  # the clock was set anew
                self._least.clear()
            elif t_ns < newest_t_ns:
                return
        self._least.append((t_ns, offset_ns))

    def gauges(self) -> dict[str, float]:
        """``clock.offset_s``, host less sensor at the newest second, and ``clock.drift_ppm``, once they are known."""
        if not self._least:
            return {}
        t_ns = np.array([t - self._least[-1][0] for t, _ in self._least], np.float64)
        base_ns = self._least[-1][1]
        excess_ns = np.array([offset - base_ns for _, offset in self._least], np.float64)
        if len(self._least) < DRIFT_AFTER:
            return {"clock.offset_s": (base_ns + float(excess_ns.min())) / NS_PER_S}
        i, j = np.triu_indices(len(t_ns), 1)
        drift = float(np.median((excess_ns[j] - excess_ns[i]) / (t_ns[j] - t_ns[i])))
        offset_ns = base_ns + float((excess_ns - drift * t_ns).min())
        return {"clock.offset_s": offset_ns / NS_PER_S, "clock.drift_ppm": 1e6 * drift}
