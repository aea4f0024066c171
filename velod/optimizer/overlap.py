"""Edges that several batches see: what their events say must not count as often as they are selected.

A flow is the plane through what happened in the neighbourhood within ``ingest.memory_ms``. An edge that needs longer
than a batch to cross its patch is fitted again in the next one, to much the same events and with much the same error:
so many in a row say as much as one in the time that it takes to cross.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from velod.config import IngestSettings
from velod.optimizer.flow_equation import Rows
from velod.types import F64, WIDE


def times_seen(speed: F64, ingest: IngestSettings) -> F64:
    """In how many batches (m,), at least 1, edges of normal flow ``speed`` (m,), px/s, show much the same events.

    Counted in batches of ``period_ms``: those that close sooner, by count, hold fast edges with errors of their own.
    """
    in_patch_s = np.minimum(WIDE / np.abs(speed), ingest.memory_ms * 1e-3)
    return np.asarray(np.maximum(in_patch_s / (ingest.period_ms * 1e-3), 1.0))


def counted_once(rows: Rows, times: F64) -> Rows:
    """The rows with their information divided by ``times`` (m,), for a window of many batches.

    A batch by itself is as good as it is: what is judged or weighted within it has the sigmas that it had.
    """
    return replace(rows, sigma=rows.sigma * np.sqrt(times))
