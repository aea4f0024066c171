"""Rigs through one router to one consumer of `velod/*/velocity`: none is silent, none pushes another out."""

from __future__ import annotations

import sys

import pytest

from velod.prove.fleet import run_fleet

pytestmark = [pytest.mark.system, pytest.mark.timed]


@pytest.mark.skipif(sys.platform != "linux", reason="reads CPU times from /proc")
def test_twenty_rigs_are_heard_by_one_consumer_each_at_its_rate() -> None:
    """Few enough for a machine that is busy; `velod prove fleet` has hundreds."""
    fleet = run_fleet(rigs=20, hz=15.0, seconds=3.0, tls=True)
    assert fleet.silent == 0
    assert fleet.share > 0.97
    assert fleet.latency_p50_ms < 20.0
    assert 0.0 < fleet.router_cores < 1.0
