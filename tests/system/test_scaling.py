"""Workers of a stage come, go, hang and are slow, on any host, while velocities flow."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import slanted_scene
from tests.system.hosts import Network, why_not
from tests.system.rig import Rig, Stalls

pytestmark = [pytest.mark.system, pytest.mark.timed, pytest.mark.skipif(bool(why_not()), reason=why_not())]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with Network("compute", "far") as network:
        yield Rig(network, slanted_scene.write(tmp_path / "slanted.h5", 14.0), tmp_path)


def shares(rig: Rig) -> dict[str, float]:
    """Of the flow batches of the last second, by worker."""
    rates = rig.seen_so_far().newest_health()["ingest-0"]["rates"]
    sent = {name.removeprefix("sent."): rate for name, rate in rates.items() if name.startswith("sent.flow")}
    return {worker: rate / sum(sent.values()) for worker, rate in sent.items()}


def test_flow_workers_come_go_hang_and_are_slow_on_any_host_and_no_velocity_is_lost(rig: Rig) -> None:
    """One worker is not enough: 25 ms for each batch, and 50 batches a second."""
    rig.start_service("ingest,depth,optimizer")
    near = rig.start_slow_worker("compute", "flow-0", ms=25.0)
    far = rig.start_slow_worker("far", "flow-1", ms=50.0)
    consumer = rig.start_consumer("far")
    player = rig.start_player("compute")
    with Stalls() as stalls:
        rig.wait_for_velocities(200)
        two = shares(rig)
        rig.start_slow_worker("far", "flow-2", ms=15.0)
        os.kill(far.pid, signal.SIGSTOP)
        time.sleep(3.2)  # longer than a link is kept
        one_hangs = shares(rig)
        os.kill(far.pid, signal.SIGCONT)
        time.sleep(2.2)
        it_is_back = shares(rig)
        near.send_signal(signal.SIGTERM)
        assert near.wait(10.0) == 0
        time.sleep(2.2)
        one_has_left = shares(rig)
        assert player.wait(30.0) == 0
    seen = rig.seen(consumer)
    assert 0.05 < two["flow-1"] < two["flow-0"]  # the slow one gets less
    assert set(one_hangs) == {"flow-0", "flow-2"}
    assert set(it_is_back) == {"flow-0", "flow-1", "flow-2"}
    assert set(one_has_left) == {"flow-1", "flow-2"}
    health = seen.newest_health()
    assert health["ingest-0"]["counters"]["dispatch.expired.flow"] >= 1
    assert health["optimizer-0"]["counters"].get("batch.lost", 0) == 0
    assert seen.lost() == 0
    assert seen.longest_gap_s() <= 0.1 + 2.0 * stalls.longest_s
