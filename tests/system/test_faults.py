"""A poor link, a black hole and a consumer that stops: what it costs those concerned, and nobody else.

Every fault, one by one, with its cost: ``python -m tests.system.faults``.
"""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from tests import slanted_scene
from tests.system.faults import FRESH_MS, Cost
from tests.system.hosts import Network, why_not
from tests.system.rig import Rig, Seen, Stalls

pytestmark = [pytest.mark.system, pytest.mark.skipif(bool(why_not()), reason=why_not())]
HOLE_S = 5.0


@pytest.mark.long  # and, since a bystander sometimes misses seconds, known to fail: docs/distribution.md
def test_what_befalls_one_consumer_is_no_other_s_concern(tmp_path: Path) -> None:
    """One behind 1 % loss, 5 ms and 100 Mbit; two in a black hole for 5 s; one that stops for 10 s; one untouched.

    The bounds are about twice what was measured on two cores (numbers and aims: docs/distribution.md). They catch
    what is broken, not a slow moment.
    """
    names = ("poor", "holed", "stopped", "bystander")
    recording = slanted_scene.write(tmp_path / "slanted.h5", 14.0)
    with Network("compute", *names) as network, Stalls() as stalls:
        network["poor"].shape(delay_ms=5.0, loss=0.01, mbit=100.0)
        rig = Rig(network, recording, tmp_path)
        rig.start_service()
        processes = {name: rig.start_consumer(name, name) for name in names}
        player = rig.start_player("compute")
        rig.wait_for_velocities(150, "bystander")
        network["holed"].black_hole(swallows=True)
        os.kill(processes["stopped"].pid, signal.SIGSTOP)
        began_ns = time.time_ns()
        time.sleep(HOLE_S)
        network["holed"].black_hole(swallows=False)
        healed_ns = time.time_ns()
        time.sleep(10.0 - HOLE_S)
        os.kill(processes["stopped"].pid, signal.SIGCONT)
        awake_ns = time.time_ns()
        assert player.wait(30.0) == 0
        seen = {name: rig.seen(process, name) for name, process in processes.items()}
    busy_s = 2.0 * stalls.longest_s
    untouched = seen["bystander"]
    assert untouched.longest_gap_s() <= 0.25 + busy_s
    assert untouched.lost_on_the_way() == seen["poor"].lost_on_the_way() == 0
    assert np.percentile(seen["poor"].travel_ms(), 99) <= 150.0 + 1e3 * busy_s
    # TCP tries to connect once a second: to the introducer, which tells of the consumer, and then from the optimizer.
    assert Cost.of(seen["holed"], (began_ns, healed_ns)).back_s <= 4.0 + busy_s
    assert Cost.of(seen["stopped"], (began_ns, awake_ns)).back_s <= 2.0 + busy_s
    for name in names:
        assert_fresh(seen[name], busy_s)


def assert_fresh(seen: Seen, busy_s: float) -> None:
    """What was handed out was younger than the client's limit, by a clock that the client cannot see."""
    assert seen.oldest_ms() <= FRESH_MS + 1e3 * busy_s
