"""Counting what the kernels of ingest have dropped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from velod.types import I64


def count_drops(counters: Counter[str], causes: Sequence[str], dropped: I64) -> None:
    """Add ``dropped`` (len(causes),) to ``counters``, each under its cause; a cause without any is not named."""
    for cause, count in zip(causes, dropped.tolist(), strict=True):
        if count:
            counters[cause] += count
