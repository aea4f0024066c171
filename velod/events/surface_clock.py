"""Stamps on the surfaces of one camera: ns since an epoch that follows the sensor's time, in 32 bits.

With 64 bits surfaces would be twice as large. Those of two cameras are beyond the caches in any case, and what an
event costs is mostly the wait for the two lines of memory that it changes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numba import njit

from velod.types import I32, I64

EMPTY = -(2**31)
"""Stamp of a pixel without events."""
OLDEST = -(2**30)
"""Stamps are no older when the epoch has moved: 1.07 s before it, more than any memory (1 s)."""
LATEST = 2**31 - 1
NO_EPOCH = -(2**62)


class SurfaceClock:
    """Makes surfaces, and moves the epoch of all of them on before an event's stamp would not fit."""

    def __init__(self, height: int, width: int) -> None:
        self.epoch_ns = NO_EPOCH
        self._shape = (2, height, width)
        self._surfaces: list[I32] = []

    def new_surface(self) -> I32:
        """An empty surface (2, height, width): index 0 = OFF, 1 = ON."""
        self._surfaces.append(new_surface(*self._shape[1:]))
        return self._surfaces[-1]

    def stamp(self, t_ns: int) -> int:
        """A time to compare stamps with; one before all of them is ``OLDEST``."""
        return max(t_ns - self.epoch_ns, OLDEST)

    def spans(self, t_ns: I64) -> Iterator[slice]:
        """Parts of event times (n,), ns, not before those of any event so far, each of which fits the epoch of its
        turn. Nearly always one.
        """
        start = 0
        while start < len(t_ns):
            stop = len(t_ns)
            if t_ns[-1] - self.epoch_ns > LATEST:
                self._move(int(t_ns[start]))
                stop = int(np.searchsorted(t_ns, self.epoch_ns + LATEST, side="right"))
            yield slice(start, stop)
            start = stop

    def _move(self, epoch_ns: int) -> None:
        for surface in self._surfaces:
            _set_back(surface.reshape(-1), epoch_ns - self.epoch_ns)
        self.epoch_ns = epoch_ns


def new_surface(height: int, width: int) -> I32:
    """An empty surface (2, height, width) for stamps."""
    return np.full((2, height, width), EMPTY, np.int32)


@njit(cache=True, nogil=True)
def _set_back(stamp: I32, by_ns: int) -> None:
    for i in range(stamp.size):
        moved = stamp[i] - by_ns
        stamp[i] = moved if moved >= OLDEST else EMPTY
