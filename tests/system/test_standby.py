"""A second optimizer stands by: whatever happens to the first, consumers see one stream."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from tests import slanted_scene
from tests.system.hosts import Network, why_not
from tests.system.rig import Rig, Stalls
from velod.config import OptimizerSettings, Settings

pytestmark = [pytest.mark.system, pytest.mark.timed, pytest.mark.skipif(bool(why_not()), reason=why_not())]


SECONDS = 9.0


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    directory = tmp_path_factory.mktemp("standby")
    recording = slanted_scene.write(directory / "slanted.h5", SECONDS)
    with Network("compute", "consumer") as network:
        rig = Rig(network, recording, directory, replace(Settings(), optimizer=OptimizerSettings(workers=2)))
        rig.start_service()
        yield rig


def leader(rig: Rig) -> int:
    """Its process, by the health of both, of which one leads and one stands by; asked while velocities flow."""
    pids = {h["role"]: h["pid"] for h in rig.seen_so_far().newest_health().values() if h["stage"] == "optimizer"}
    assert sorted(pids) == ["leads", "standby"]
    return int(pids["leads"])


def test_a_service_is_at_work_before_it_loads_those_that_stand_by(rig: Rig) -> None:
    """All at once, the first of each stage would come as late as the last."""
    log = rig.log("service")
    firsts = [log.index(f"{worker}-0 INFO up") for worker in ("ingest", "flow", "depth", "optimizer")]
    assert log.index("optimizer-1: process") > max(firsts)


def test_whatever_happens_to_the_leader_consumers_see_one_stream(rig: Rig) -> None:
    """The leader is killed; the one that took over is stopped for 1.2 s, and goes on."""
    consumer = rig.start_consumer("consumer")
    with Stalls() as stalls:
        kill_one_and_stop_the_other(rig)
    seen = rig.seen(consumer)
    steps_ns = np.diff([row["sensor_t_ns"] for row in seen.used])
    odd = [(seen.used[i : i + 2], seen.counters) for i in np.flatnonzero(abs(steps_ns - 13_500_000) >= 500_000)]
    assert odd == [], "each tick once, in order"
    assert (np.diff([row["seq"] for row in seen.used]) == 1).all()
    assert all(row["valid"] for row in seen.used[75:])
    # Both the one that is late and the one that takes over may have waited for a busy machine.
    assert seen.longest_gap_s() <= 0.1 + 2.0 * stalls.longest_s


def kill_one_and_stop_the_other(rig: Rig) -> None:
    player = rig.start_player("compute")
    rig.wait_for_velocities(150)
    os.kill(leader(rig), signal.SIGKILL)
    rig.wait_for_velocities(350)
    os.kill(pid := leader(rig), signal.SIGSTOP)
    time.sleep(1.2)
    os.kill(pid, signal.SIGCONT)
    rig.wait_for_velocities(570)
    assert player.wait(60.0) == 0
