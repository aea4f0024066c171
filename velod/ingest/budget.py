"""How much of the stream ingest may take on: an input of the stage, like the stream itself."""

from __future__ import annotations

import sys
from dataclasses import dataclass

MOST_HZ = 75.0
"""More batches than outputs make no output newer; one that ends with an output is in it at once."""
BAND_ROWS = 64
"""Events are thinned by rows: of so many consecutive ones the first are kept, in both cameras the same.

Whole rows, because a plane needs all of its neighbourhood and block matching needs the same rows of both cameras.
"""
LEAST_ROWS = 24
"""Fewer rows side by side hold no block (17) with room for neighbourhoods around it."""


@dataclass(frozen=True, slots=True)
class Budget:
    """The default takes on everything: so it is offline, where the result depends on the stream alone."""

    selection: float = 1.0  # share of the quota that a batch may select
    rows: float = 1.0  # share of the sensor's rows whose events are looked at
    batches: float = 1.0  # share of the batches that are made, evenly spread
    room: int = sys.maxsize  # so many more may be made; those beyond are not
    slices: bool = True  # event by event: what is selected may go out before its batch ends
    spaced: bool = False  # however many events there are, batches are no more than MOST_HZ, and end with outputs

    def quota(self, full: int) -> int:
        """Events that a batch may select, at least 1."""
        return max(1, round(full * self.selection))

    @property
    def band_rows(self) -> int:
        """Rows that are kept of each BAND_ROWS."""
        return max(LEAST_ROWS, min(BAND_ROWS, round(BAND_ROWS * self.rows)))
