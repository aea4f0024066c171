"""Event-by-event mode of ingest: slices of a batch, the StereoBatch of the same events, and what may go wrong."""

from __future__ import annotations

import numpy as np
import pytest

from tests.moving_edges import T0_NS, Events, calibration, edges, event_batches, settings
from velod.config import ConfigError
from velod.ingest.budget import Budget
from velod.ingest.stage import IngestStage
from velod.types import EventBatch, EventPacket, ImuSamples, StereoBatch

MS = 1_000_000


def stage(**ingest: object) -> IngestStage:
    return IngestStage(settings(mode="event", **ingest), calibration())


def run(e: Events, t_ns: int, ingest: IngestStage | None = None, seq: int = 0) -> list[object]:
    """The same events in both cameras, known up to ``t_ns``."""
    ingest = ingest or stage()
    return [*ingest.handle(e.packet(seq, t_ns, "right")), *ingest.handle(e.packet(seq, t_ns))]


def by_batch(messages: list[object]) -> list[tuple[StereoBatch, list[EventBatch]]]:
    parts = event_batches(messages)
    return [(m, [p for p in parts if p.batch_seq == m.seq]) for m in messages if isinstance(m, StereoBatch)]


def test_the_slices_of_a_batch_hold_the_events_of_its_stereo_batch_in_their_order() -> None:
    batches = by_batch(run(edges(), T0_NS + 100 * MS, stage(count=10**6)))
    assert len(batches) >= 9
    assert max(len(parts) for _, parts in batches) > 3
    for stereo, parts in batches:
        assert [p.first for p in parts] == np.cumsum([0] + [len(p.x) for p in parts[:-1]]).tolist()
        for name in ("x", "y", "p"):
            assert np.array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(stereo, name))
        t_ns = np.concatenate([p.t_ns - p.age.astype(np.int64) for p in parts])
        assert np.array_equal(t_ns, stereo.t_ns - stereo.age.astype(np.int64))
        assert {p.t_start_ns for p in parts} == {stereo.t_start_ns}


def test_slices_end_on_their_grid_or_with_the_batch_and_are_numbered_one_by_one() -> None:
    out = run(edges(), T0_NS + 100 * MS, stage(slice_ms=2.0, batch="count", count=700))
    parts = event_batches(out)
    ends = {m.t_ns for m in out if isinstance(m, StereoBatch)}
    assert all(p.t_ns % (2 * MS) == 0 or p.t_ns in ends for p in parts)
    assert any(p.t_ns in ends and p.t_ns % (2 * MS) for p in parts)
    assert [p.seq for p in parts] == list(range(len(parts)))
    for p in parts:
        # what completes a neighbourhood lies in the slice
        newest_age = np.where(p.ring > 0, p.ring, 2**31).min(axis=1)
        assert ((newest_age >= 1) & (newest_age <= 2 * MS)).all()


def test_a_slice_goes_out_while_its_batch_is_still_open() -> None:
    e = edges(seconds=0.03)
    ingest = stage(period_ms=30.0, count=10**6)
    out = run(e[e.t_ns < T0_NS + 25 * MS], T0_NS + 25 * MS, ingest)
    assert len(event_batches(out)) > 5
    assert not [m for m in out if isinstance(m, StereoBatch)]
    newest = event_batches(out)[-1]
    assert T0_NS + 20 * MS < newest.t_ns <= T0_NS + 25 * MS


def test_a_batch_without_selected_events_has_one_empty_slice() -> None:
    lonely = Events(
        np.array([9], np.uint16), np.array([9], np.uint16), np.array([T0_NS], np.int64), np.array([1], np.uint8)
    )
    out = run(lonely, T0_NS + 25 * MS)
    batches = by_batch(out)
    assert len(batches) == 2
    for stereo, parts in batches:
        (part,) = parts
        assert len(stereo.x) == len(part.x) == part.first == 0
        assert part.t_ns == stereo.t_ns
    assert [parts[0].n_events for _, parts in batches] == [1, 0]


def test_word_of_a_closed_batch_comes_after_its_parts() -> None:
    out = run(edges(), T0_NS + 60 * MS)
    told = -1
    for m in out:
        if isinstance(m, ImuSamples):
            told = m.batch_seq
        elif isinstance(m, EventBatch):
            assert m.batch_seq == told + 1


def test_parts_of_a_batch_that_a_clock_restart_cuts_off_join_no_other() -> None:
    ingest = stage(period_ms=30.0, count=10**6)
    e = edges(seconds=0.05)
    late = Events(e.x, e.y, e.t_ns + 20_000 * MS, e.p)
    cut_off = event_batches(run(late[late.t_ns < T0_NS + 20_020 * MS], T0_NS + 20_020 * MS, ingest))
    assert {p.batch_seq for p in cut_off} == {0}
    out = run(e, T0_NS + 50 * MS, ingest, seq=1)
    assert ingest.counters["clock.restart"] == 1
    assert min(p.batch_seq for p in event_batches(out)) == 1
    assert next(m.seq for m in out if isinstance(m, StereoBatch)) == 1


def test_a_silence_of_hours_costs_nothing() -> None:
    ingest = stage()
    run(edges(seconds=0.02), T0_NS + 20 * MS, ingest)
    hour = T0_NS + 3_600_000 * MS
    e = edges(seconds=0.02)
    later = Events(e.x, e.y, e.t_ns + hour - T0_NS, e.p)
    nothing = EventPacket(1, hour, "right", *(c[:0] for c in (e.x, e.y, e.t_ns, e.p)))
    ingest.handle(nothing)
    out = ingest.handle(EventPacket(1, hour, "left", *(c[:0] for c in (e.x, e.y, e.t_ns, e.p))))
    assert len(event_batches(out)) < 110  # a second of empty batches
    assert len(event_batches(run(later, hour + 20 * MS, ingest, seq=2))) > 5


def test_the_papers_rules_need_batches() -> None:
    with pytest.raises(ConfigError, match=r"ingest\.selection: must be 'burst' with ingest\.mode = 'event'"):
        settings(mode="event", selection="paper")


def test_what_was_selected_of_a_batch_that_the_budget_forbids_belongs_to_the_next() -> None:
    e = edges()
    whole, limited = stage(), stage()
    full = by_batch(run(e, T0_NS + 100 * MS, whole))
    out: list[object] = limited.handle(e.packet(0, T0_NS + 100 * MS, "right"))
    for k in range(10):
        limited.budget = Budget(room=k % 2)
        t = T0_NS + 10 * MS * k
        out += limited.handle(e[(e.t_ns >= t) & (e.t_ns < t + 10 * MS)].packet(k, t + 10 * MS))
    made = by_batch(out)
    assert limited.counters["shed.batches"] > 3
    assert len(made) < len(full) - 3
    for stereo, parts in made:
        assert np.array_equal(np.concatenate([p.x for p in parts]), stereo.x)
        assert {p.t_start_ns for p in parts} == {stereo.t_start_ns}
    for name in ("x", "y", "p"):
        columns = [np.concatenate([getattr(stereo, name) for stereo, _ in batches]) for batches in (made, full)]
        assert np.array_equal(columns[0], columns[1][: len(columns[0])])


def test_while_slices_wait_the_same_events_go_out_at_the_end_of_their_batch() -> None:
    e = edges(seconds=0.1)
    usual, held = stage(count=10**6), stage(count=10**6)
    held.budget = Budget(slices=False)
    by_slice, at_once = (by_batch(run(e, T0_NS + 100 * MS, ingest)) for ingest in (usual, held))
    assert max(len(parts) for _, parts in by_slice) > 3
    assert [len(parts) for _, parts in at_once] == [1] * len(by_slice)
    for (stereo, parts), (same, (whole,)) in zip(by_slice, at_once, strict=True):
        assert np.array_equal(stereo.x, same.x)
        for name in ("x", "y", "p"):
            assert np.array_equal(np.concatenate([getattr(q, name) for q in parts]), getattr(whole, name))
        assert whole.t_ns == stereo.t_ns


def test_a_smaller_budget_selects_fewer_events() -> None:
    e = edges()
    full, half = stage(), stage()
    half.budget = Budget(selection=0.25)
    n = [sum(len(p.x) for p in event_batches(run(e, T0_NS + 100 * MS, ingest))) for ingest in (full, half)]
    assert 0.15 * n[0] < n[1] < 0.6 * n[0]
