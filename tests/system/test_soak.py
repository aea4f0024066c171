"""A minute of `velod prove soak`: faults at random, and nothing that grows. Half an hour is that command's own."""

from __future__ import annotations

import json
import logging
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from velod.prove.soak import soak

pytestmark = [pytest.mark.system, pytest.mark.timed]


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_faults_at_random_leave_nothing_behind(slanted: Path) -> None:
    """A minute tells a growth of megabytes, not of one an hour."""
    result = soak(slanted, seconds=60.0, fault_every_s=6.0, seed=1, on_fault=logging.getLogger("soak").info)
    assert result.failures() == []
    assert sum(result.faults.values()) >= 2
    assert json.loads(json.dumps(asdict(result)))["faults"] == result.faults
    assert {"supervisor", "driver"} <= {p.worker for p in result.processes}
    assert result.longest_gap_s < 3.0
    assert result.served > 60.0 * 75 * 0.7
