"""32-bit stamps: the same times as with 64 bits, however long the sensor runs, and whenever its clock began."""

from __future__ import annotations

import numpy as np
import pytest

from tests.moving_edges import T0_NS, Events, calibration, edges, settings
from velod.events.surface_clock import EMPTY, LATEST, OLDEST, SurfaceClock
from velod.ingest.stage import IngestStage
from velod.types import EventBatch, StereoBatch

MS = 1_000_000
S = 1000 * MS


@pytest.mark.parametrize("begin_ns", [0, -9 * S, 2**60 + 7])
def test_stamps_are_the_events_times_across_moves_of_the_epoch(begin_ns: int) -> None:
    rng = np.random.default_rng(1)
    clock = SurfaceClock(1, 4)
    surface = clock.new_surface()
    latest: dict[int, int | None] = dict.fromkeys(range(4))
    steps_ns = np.concatenate([rng.integers(0, 40 * MS, 400), [3 * S, 9 * S], rng.integers(0, 40 * MS, 200)])
    t_ns = begin_ns + np.cumsum(rng.permutation(steps_ns))
    x = rng.integers(0, 4, len(t_ns))
    for packet in np.split(np.arange(len(t_ns)), [1, 50, 300]):
        for part in clock.spans(t_ns[packet]):
            for i in packet[part]:
                surface[0, 0, x[i]] = t_ns[i] - clock.epoch_ns
                latest[int(x[i])] = int(t_ns[i])
            for column, time_ns in latest.items():
                held = int(surface[0, 0, column])
                if time_ns is None or t_ns[packet[part]][-1] - time_ns > LATEST - OLDEST:
                    assert held == EMPTY
                elif held != EMPTY:
                    assert held + clock.epoch_ns == time_ns
                else:
                    assert clock.epoch_ns - time_ns > -OLDEST


def test_a_time_long_before_the_epoch_is_before_every_stamp_and_after_none() -> None:
    clock = SurfaceClock(2, 2)
    surface = clock.new_surface()
    list(clock.spans(np.array([5 * S])))
    surface[0, 0, 0] = clock.stamp(5 * S)
    list(clock.spans(np.array([8 * S])))
    assert surface[0, 0, 0] == EMPTY
    assert clock.stamp(6 * S) == OLDEST
    assert clock.stamp(8 * S) - clock.stamp(8 * S - 900 * MS) == 900 * MS
    # Nothing within the longest memory of any time that can be asked for.
    assert clock.stamp(0) - EMPTY > S


@pytest.mark.parametrize("mode", ["batch", "event"])
def test_what_ingest_puts_out_does_not_depend_on_when_the_epoch_began(mode: str) -> None:
    """An event 2.1 s ahead of the others has the epoch move on in the midst of these."""
    e = edges(angle=0.4, seconds=0.12)
    ahead_ns = T0_NS + 60 * MS - LATEST
    early = Events(np.insert(e.x, 0, 20), np.insert(e.y, 0, 20), np.insert(e.t_ns, 0, ahead_ns), np.insert(e.p, 0, 1))
    results = []
    for events in (e, early):
        ingest = IngestStage(settings(mode=mode, batch="time", quota=5000), calibration())
        end_ns = T0_NS + 120 * MS
        out = [*ingest.handle(events.packet(0, end_ns, "right")), *ingest.handle(events.packet(0, end_ns))]
        late = [m for m in out if isinstance(m, EventBatch | StereoBatch) and m.t_ns > T0_NS]
        columns = ("left", "right", "left_last", "right_last", "x", "y", "age", "p", "patch", "ring")
        results.append([(m.t_ns, *(getattr(m, name, None) for name in columns)) for m in late])
    plain, moved = results
    assert len(plain) == len(moved) > 8
    assert sum(len(of[5]) for of in plain) > 500
    for ours, others in zip(plain, moved, strict=True):
        for a, b in zip(ours, others, strict=True):
            assert np.array_equal(a, b)
