"""``velod prove scaling``: where one flow worker is too slow, two are enough, and the command sees that."""

from __future__ import annotations

from pathlib import Path

import pytest

from velod.prove.scaling import scaling

pytestmark = pytest.mark.system


@pytest.mark.long
def test_two_workers_do_what_one_cannot(slanted: Path) -> None:
    """30 ms for each of 50 batches a second: one does two thirds of them, and ingest makes no more than that."""
    one, two = scaling(slanted, [1, 2], load_ms=30.0, speed=1.0, say=str)
    assert one.flow_hz < 1e3 / 30.0 and one.shed + one.dropped > 0
    assert two.flow_hz > 1.2 * one.flow_hz
    assert two.latency_p50_ms < 0.6 * one.latency_p50_ms
    assert set(two.costs) == {"ingest", "flow", "depth", "optimizer"}
    assert all(cost.cores > 0.0 and cost.mb_s > 0.0 for cost in two.costs.values())
