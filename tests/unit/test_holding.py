"""What a soak calls a leak: what is kept of every death is one, what only looks like it is none."""

from __future__ import annotations

import sys
from dataclasses import replace
from multiprocessing.shared_memory import SharedMemory
from os import getpid

import numpy as np
import pytest

from velod.prove.holding import WARM_UP_S, Hit, Series, judge
from velod.prove.processes import shared_memory_mib
from velod.prove.soak import MAX_DEATH_MIB, Soak

SECONDS = 180.0
HITS: list[Hit] = [
    (20.0, "kill ingest-0"),
    (28.0, "stop ingest-0"),
    (36.0, "kill flow-0"),
    (45.0, "kill depth-0"),
    (60.0, "stop depth-0"),
    (75.0, "kill flow-0"),
    (90.0, "kill depth-0"),
    (105.0, "kill depth-0"),
]


def held(more_after: dict[float, float], base_mib: float = 140.0) -> Series:
    """A process that holds more from these times on: t_s -> MiB."""
    t_s = [float(t) for t in range(int(SECONDS))]
    used_mib = [base_mib + sum(m for at, m in more_after.items() if t > at) for t in t_s]
    return Series(1, t_s, list(used_mib), used_mib, [40] * len(t_s))


def of(series: Series, hits: list[Hit] = HITS) -> float | None:
    return judge("optimizer-0", series, SECONDS, hits).death_mib


def test_what_a_process_keeps_of_every_death_is_a_leak() -> None:
    leak = {t: MAX_DEATH_MIB + 1.0 for t, fault in HITS if fault.startswith("kill")}
    assert of(held(leak)) == pytest.approx(MAX_DEATH_MIB + 1.0)


def test_so_is_what_it_keeps_of_every_death_of_one_kind() -> None:
    leak = {t: MAX_DEATH_MIB + 1.0 for t, fault in HITS if fault == "kill flow-0"}
    assert of(held(leak)) == pytest.approx(MAX_DEATH_MIB + 1.0)


def test_what_it_takes_to_catch_up_is_none() -> None:
    """After others were stopped it is no death's; and at one death of many it is no rule."""
    assert of(held({28.0: 20.0, 60.0: 12.0})) == 0.0
    assert of(held({45.0: 30.0})) == 0.0


def test_what_was_freed_and_is_kept_for_what_comes_next_is_none() -> None:
    series = held({})
    series.mib = held({t: 12.0 for t, _ in HITS}).mib
    assert of(series) == 0.0


def test_deaths_before_it_was_warm_and_single_ones_say_nothing() -> None:
    early: list[Hit] = [(WARM_UP_S - 5.0, "kill flow-0"), (WARM_UP_S - 2.0, "kill flow-0"), (60.0, "kill flow-0")]
    assert of(held({2.0: 50.0, 6.0: 50.0}), early) is None


def soak_of(growth_mib: float) -> Soak:
    faults = {"kill flow-0": 2, "kill depth-0": 3, "kill ingest-0": 1}
    return Soak(180.0, faults, 9000, 0.4, 20.0, "kill ingest-0", "", 10.0, 10.0, 150.0, growth_mib, 1.0, [])


def test_one_pool_that_nobody_owns_any_more_is_a_leak_of_the_host_s() -> None:
    assert soak_of(growth_mib=6 * 1.3).failures() == []
    assert [f.split(" by ")[0] for f in soak_of(growth_mib=6 * 1.3 + 64.0).failures()] == ["shared memory grew"]


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_shared_memory_is_counted_once_and_by_what_it_holds() -> None:
    before = shared_memory_mib([getpid()])
    piece = SharedMemory(create=True, size=8 << 20)
    other = SharedMemory(name=piece.name)
    try:
        assert shared_memory_mib([getpid()]) == before, "nothing is in it yet"
        np.frombuffer(piece.buf, np.uint8)[: 2 << 20] = 1
        assert shared_memory_mib([getpid(), getpid()]) - before == pytest.approx(2.0)
    finally:
        other.close()
        piece.close()
        piece.unlink()


def test_growth_after_the_last_fault_is_told_apart_from_what_deaths_cost() -> None:
    series = held({})
    series.mib = series.used_mib = [140.0 + 0.1 * max(0.0, t - 120.0) for t in series.t_s]
    result = judge("optimizer-0", series, SECONDS, HITS)
    assert (result.death_mib, result.growth_mib) == (0.0, pytest.approx(5.9, abs=0.1))
    assert replace(soak_of(0.0), processes=[result]).failures() == ["optimizer-0 grew by 5.9 MiB in the last third"]


def test_a_burst_after_the_last_fault_is_no_growth() -> None:
    """Others kept ingest from working for a while: 57 MiB waited, were freed, and are kept for what comes next."""
    series = held({})
    series.mib = held({150.0: 57.0}).mib
    assert judge("ingest-0", series, SECONDS, HITS).growth_mib == 0.0
