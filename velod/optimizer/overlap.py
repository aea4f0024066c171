"""Edges that several batches see: what their events say must not count as often as they are selected.

A flow is the plane through what happened in the neighbourhood within ``ingest.memory_ms``. An edge that needs longer
than a batch to cross its patch is fitted again in the next one, to much the same events and with much the same error:
so many in a row say as much as one in the time that it takes to cross.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from velod.config import IngestSettings
from velod.optimizer.flow_equation import Rows
from velod.types import F64, WIDE


def times_seen(speed: F64, ingest: IngestSettings) -> F64:
    """In how many batches (m,), at least 1, edges of normal flow ``speed`` (m,), px/s, show much the same events.

    Counted in batches of ``period_ms``: those that close sooner, by count, hold fast edges with errors of their own.
    """
    times = np.empty_like(speed)
    _times_seen(speed, ingest.memory_ms * 1e-3, ingest.period_ms * 1e-3, times)
    return times


def counted_once(rows: Rows, times: F64) -> Rows:
    """The rows with their information divided by ``times`` (m,), for a window of many batches.

    A batch by itself is as good as it is: what is judged or weighted within it has the sigmas that it had.
    """
    return replace(rows, sigma=rows.sigma * np.sqrt(times))


@njit(cache=True, nogil=True)
def _times_seen(speed: F64, memory_s: float, period_s: float, out: F64) -> None:
    for k in range(speed.size):
        in_patch_s = WIDE / abs(speed[k]) if abs(speed[k]) * memory_s > WIDE else memory_s
        out[k] = max(in_patch_s / period_s, 1.0)
