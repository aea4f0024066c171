"""Load shedding: shares fall while something is late, recover by themselves, and ingest keeps to its budget."""

from __future__ import annotations

import numpy as np
import pytest

from tests.moving_edges import T0_NS, calibration, edges, event_batches, settings
from velod.config import Settings, from_tree
from velod.ingest.budget import BAND_ROWS, LEAST_ROWS, Budget
from velod.ingest.stage import IngestStage
from velod.runtime.budget import (
    EVENT_GRACE_S,
    GRACE_S,
    HURRIED_S,
    LEAST_SELECTION,
    MAX_WAITING,
    NO_PACKET,
    SPACED_FOR_S,
    STANDING_S,
    STANDING_SELECTION,
    LoadShedder,
)
from velod.ticks import tick_after, tick_ns
from velod.types import NS_PER_S, ImuSamples, StereoBatch

TARGET_S = 0.05
SPACED = Budget(room=MAX_WAITING, spaced=True)
"""Everything is taken on, in no more batches than outputs."""


def run(load: LoadShedder, delay_s: float, start_s: float, seconds: float) -> float:
    """The workers are late by ``delay_s`` for so long, told every 10 ms; returns when that is over."""
    steps = round(seconds / 0.01)
    for i in range(steps):
        load.note_workers(delay_s, 0, start_s + 0.01 * i)
    return start_s + seconds


def test_without_delay_everything_is_taken_on() -> None:
    load = LoadShedder(TARGET_S)
    now_s = run(load, 0.4 * TARGET_S, 0.0, 1.0)
    assert load.takes_packet(0.4 * TARGET_S, now_s)
    assert load.budget() == Budget(room=MAX_WAITING)


def test_a_batch_that_takes_too_long_makes_batches_as_few_as_outputs_at_once_and_for_a_while() -> None:
    load = LoadShedder(TARGET_S)
    load.note_workers(0.0, 0, 0.0)
    load.note_unanswered(0.9 * HURRIED_S, 0.0)
    assert load.budget() == Budget(room=MAX_WAITING)
    load.note_unanswered(1.1 * HURRIED_S, 0.0)
    assert load.budget() == SPACED
    assert load.gauges()["batches.spaced"] == 1.0
    load.note_unanswered(0.0, 0.99 * SPACED_FOR_S)
    assert load.budget() == SPACED
    load.note_unanswered(0.0, 1.01 * SPACED_FOR_S)
    assert load.budget() == Budget(room=MAX_WAITING)
    assert load.gauges()["batches.spaced"] == 0.0


def test_late_workers_get_fewer_events_then_no_batches_and_all_again_when_they_are_not() -> None:
    load = LoadShedder(TARGET_S)
    now_s = run(load, 1.5 * TARGET_S, 0.0, GRACE_S)
    assert load.budget().selection == 1.0, "a moment's delay is no overload"
    now_s = run(load, 1.5 * TARGET_S, now_s, 0.2)
    assert LEAST_SELECTION < load.budget().selection < 0.6
    assert load.budget().room == MAX_WAITING
    now_s = run(load, 2.5 * TARGET_S, now_s, 2.0)
    assert load.budget().selection == LEAST_SELECTION
    assert load.budget().room == 0
    now_s = run(load, 0.0, now_s, 1.0)
    assert 0.5 < load.budget().selection < 0.7
    run(load, 0.0, now_s, 1.0)
    assert load.budget() == Budget(room=MAX_WAITING)


def test_a_queue_that_stands_is_drained_by_fewer_events_but_half_of_them_stay() -> None:
    load = LoadShedder(10.0 * STANDING_S)
    now_s = run(load, 1.2 * STANDING_S, 0.0, GRACE_S)
    assert load.budget() == Budget(room=MAX_WAITING), "a moment's queue is none that stands"
    now_s = run(load, 1.2 * STANDING_S, now_s, 0.5)
    assert STANDING_SELECTION < load.budget().selection < 0.9
    now_s = run(load, 9.0 * STANDING_S, now_s, 3.0)
    assert load.budget() == Budget(selection=STANDING_SELECTION, room=MAX_WAITING)
    run(load, 0.4 * STANDING_S, now_s, 1.1)
    assert load.budget() == Budget(room=MAX_WAITING)


def test_a_queue_that_is_short_now_and_then_does_not_stand() -> None:
    load = LoadShedder(10.0 * STANDING_S)
    now_s = 0.0
    for _ in range(10):
        now_s = run(load, 3.0 * STANDING_S, now_s, 0.8 * GRACE_S)
        now_s = run(load, 0.9 * STANDING_S, now_s, 0.01)
    assert load.budget() == Budget(room=MAX_WAITING)


def test_an_ingest_that_is_late_makes_fewer_batches_then_looks_at_fewer_rows() -> None:
    load = LoadShedder(TARGET_S)
    for i in range(-25, 20):
        assert load.takes_packet(1.5 * TARGET_S, 0.01 * i)
    assert 0.3 < load.budget().batches < 0.6
    assert load.budget().rows == 1.0
    for i in range(20, 85):
        assert load.takes_packet(2.5 * TARGET_S, 0.01 * i)
    assert load.budget().rows < 0.6
    for i in range(85, 325):
        assert load.takes_packet(0.0, 0.01 * i)
    assert load.budget() == Budget(room=MAX_WAITING)


def test_a_stream_that_is_far_too_much_loses_rows_and_then_no_more_packets() -> None:
    """Twice as much as can be looked at, in packets of 5 ms."""
    load = LoadShedder(TARGET_S)
    waited_s, dropped = 0.0, []
    for i in range(400):
        taken = load.takes_packet(waited_s, 0.005 * i)
        dropped.append(not taken)
        cost_s = 0.01 * load.budget().rows if taken else 0.0
        waited_s = max(0.0, waited_s + cost_s - 0.005)
    assert any(dropped[:200])
    assert np.mean(dropped[200:]) < 0.1
    assert load.budget().rows < 0.7


def test_event_by_event_packets_and_slices_may_wait_for_their_own_target() -> None:
    load = LoadShedder(TARGET_S, 0.2 * TARGET_S)
    assert load.takes_packet(0.2 * NO_PACKET * TARGET_S - 1e-3, 0.0)
    assert not load.takes_packet(0.2 * NO_PACKET * TARGET_S + 1e-3, 0.0)
    load.note_slices(0.0, 1, 0.0)
    assert not load.budget().slices
    load.note_slices(0.0, 0, 0.0)
    assert load.budget() == Budget(room=MAX_WAITING)
    for i in range(round(EVENT_GRACE_S / 0.01) + 6):
        load.note_workers(0.3 * TARGET_S, 0, 0.01 * i)
        load.note_slices(0.3 * TARGET_S, 0, 0.01 * i)
    assert LEAST_SELECTION < load.budget().selection < 0.6


def test_batches_are_made_only_while_there_is_room_to_wait() -> None:
    load = LoadShedder(TARGET_S)
    load.note_workers(0.0, MAX_WAITING - 3, 0.0)
    assert load.budget().room == 3
    load.note_workers(0.0, MAX_WAITING + 1, 0.0)
    assert load.budget().room == 0


def test_old_packets_are_dropped_until_the_backlog_is_gone_and_counted() -> None:
    load = LoadShedder(TARGET_S)
    waited = np.array([0.5, NO_PACKET - 0.1, NO_PACKET + 0.1, 2.5, 2.1, 1.9, 2.5]) * TARGET_S
    assert [load.takes_packet(w, 0.01 * i) for i, w in enumerate(waited)] == [
        True,
        True,
        False,
        False,
        False,
        True,
        True,
    ]
    assert load.counters == {"shed.packets": 3}


def test_health_tells_the_share_of_the_period_and_raises_an_alarm_while_it_is_small() -> None:
    load = LoadShedder(TARGET_S)
    run(load, 1.5 * TARGET_S, 0.0, 1.0)
    load.note_batch()
    load.end_period({"shed.batches": 1})
    share = load.budget().selection
    gauges = load.gauges()
    assert (gauges["share.selection"], gauges["share.events"]) == (share / 2, 1.0)
    assert f"{share / 2:.0%} of the quota" in load.alarms()["load.selection"]
    run(load, 0.0, 1.0, 2.0)
    load.note_batch()
    load.end_period({"shed.batches": 1})
    assert load.gauges()["share.selection"] == 1.0
    assert load.alarms() == {}


def test_a_target_of_zero_sheds_nothing() -> None:
    load = LoadShedder(0.0)
    load.note_workers(100.0, 1000, 0.0)
    load.note_unanswered(100.0, 0.0)
    assert load.takes_packet(100.0, 0.0)
    assert load.budget() == Budget()
    assert load.gauges()["batches.spaced"] == 0.0


# --- the stage keeps to it


def handled(budget: Budget, chosen: Settings | None = None) -> tuple[IngestStage, list[object]]:
    ingest = IngestStage(chosen or settings(), calibration())
    ingest.budget = budget
    e = edges(seconds=0.1)
    out = [
        *ingest.handle(e.packet(0, T0_NS + 100_000_000, "right")),
        *ingest.handle(e.packet(0, T0_NS + 100_000_000)),
    ]
    return ingest, out


def test_a_batch_selects_its_share_of_the_quota() -> None:
    quota = settings().ingest.quota
    sizes = [max(len(b.x) for b in event_batches(handled(Budget(selection=s))[1])) for s in (1.0, 0.2)]
    assert sizes[0] > 0.2 * quota
    assert sizes[1] == round(0.2 * quota)


def test_batches_beyond_the_budget_have_no_number_and_the_optimizer_is_told_to_go_on() -> None:
    everything, (ingest, out) = event_batches(handled(Budget())[1]), handled(Budget(room=2))
    assert [b.seq for b in event_batches(out)] == [0, 1]
    assert ingest.counters["batches"] == 2
    assert ingest.counters["shed.batches"] == len(everything) - 2
    last = [m for m in out if isinstance(m, ImuSamples)][-1]
    assert (last.batch_seq, last.batch_t_ns, last.event_t_ns) == (1, everything[1].t_ns, everything[-1].t_ns)


@pytest.mark.parametrize("output_hz", [75.0, 200.0, 30.0])
def test_spaced_batches_end_with_outputs_or_evenly_between_and_their_period_stands(output_hz: float) -> None:
    """The edges here reach the count of 500 events in 3 to 4 ms."""

    def ends_ns(budget: Budget, period_ms: float) -> list[int]:
        tree = {"ingest": {"count": 500, "quota": 50, "period_ms": period_ms}, "optimizer": {"output_hz": output_hz}}
        return [b.t_ns for b in event_batches(handled(budget, from_tree(tree))[1])]

    natural, spaced = ends_ns(Budget(), 20.0), ends_ns(Budget(spaced=True), 20.0)
    hz = {75.0: 75.0, 200.0: 200.0 / 3.0, 30.0: 60.0}[output_hz]
    assert np.diff(natural).max() < 0.5 * NS_PER_S / hz
    assert np.diff(spaced) == pytest.approx(NS_PER_S / hz, abs=2.0)
    outputs = [tick_ns(tick_after(t_ns - 1, output_hz), output_hz) for t_ns in spaced]
    assert np.mean([a == b for a, b in zip(outputs, spaced, strict=True)]) >= (0.4 if output_hz < 75.0 else 1.0)
    assert np.diff(ends_ns(Budget(spaced=True), 10.0)).max() == 10_000_000


@pytest.mark.parametrize("period_ms", [5.0, 10.0, 20.0])
def test_spaced_batches_are_the_same_however_the_stream_was_cut_into_packets(period_ms: float) -> None:
    """Some reach their count when the next of their times is after the end of their period."""
    e, packets = edges(seconds=0.1), []
    for seq, start_ns in enumerate(range(T0_NS, T0_NS + 100_000_000, 1_000_000)):
        part = e[(e.t_ns >= start_ns) & (e.t_ns < start_ns + 1_000_000)]
        packets += [part.packet(seq, start_ns + 1_000_000, camera) for camera in ("right", "left")]
    tree = {"ingest": {"count": 500, "quota": 50, "period_ms": period_ms}}
    whole = event_batches(handled(Budget(spaced=True), from_tree(tree))[1])
    ingest = IngestStage(from_tree(tree), calibration())
    ingest.budget = Budget(spaced=True)
    cut = event_batches([out for packet in packets for out in ingest.handle(packet)])
    assert [(b.t_ns, b.n_events) for b in cut] == [(b.t_ns, b.n_events) for b in whole[: len(cut)]]
    assert len(whole) - len(cut) <= 1


def test_a_share_of_the_batches_is_spread_evenly() -> None:
    everything = event_batches(handled(Budget())[1])
    made = event_batches(handled(Budget(batches=1 / 3))[1])
    assert [b.t_ns for b in made] == [b.t_ns for b in everything[2::3]]


def test_thinning_keeps_whole_rows_the_same_in_both_cameras_and_counts_the_rest() -> None:
    ingest, out = handled(Budget(rows=0.5))
    stereo = [m for m in out if isinstance(m, StereoBatch)][-1]
    rows = np.arange(stereo.left_last.shape[0])
    kept = rows % BAND_ROWS < BAND_ROWS // 2
    for surface in (stereo.left_last, stereo.right_last):
        assert surface[kept].any(axis=1).all()
        assert not surface[~kept].any()
    assert ingest.counters["shed.events"] == 2 * np.count_nonzero(~kept[edges(seconds=0.1).y])


@pytest.mark.parametrize(("rows", "kept"), [(1.0, BAND_ROWS), (0.75, 48), (0.0, LEAST_ROWS)])
def test_enough_rows_stay_side_by_side_for_a_block(rows: float, kept: int) -> None:
    assert Budget(rows=rows).band_rows == kept
