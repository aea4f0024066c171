"""Ingest: every kind of bad input is a counted drop, batches end where they should, and the IMU is told of them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.moving_edges import (
    HEIGHT,
    T0_NS,
    WIDTH,
    Events,
    calibration,
    edges,
    event_batches,
    imu_packet,
    settings,
)
from velod.ingest.stage import IngestStage
from velod.types import NS_PER_S, EventBatch, EventPacket, ImuSamples, StereoBatch

MS = 1_000_000


def stage(**ingest: object) -> IngestStage:
    return IngestStage(settings(**ingest), calibration())


def events(t_ns: list[int], x: int = 10, y: int = 10, p: int = 1) -> Events:
    n = len(t_ns)
    return Events(
        np.full(n, x, np.uint16), np.full(n, y, np.uint16), np.array(t_ns, np.int64), np.full(n, p, np.uint8)
    )


def watermark(seq: int, t_ns: int, camera: str) -> EventPacket:
    return events([]).packet(seq, t_ns, camera)


def both(ingest: IngestStage, e: Events, t_ns: int, seq: int = 0) -> list[object]:
    """The same events in both cameras, known up to ``t_ns``."""
    return [*ingest.handle(e.packet(seq, t_ns, "right")), *ingest.handle(e.packet(seq, t_ns))]


def closed_by(ingest: IngestStage, t_ns: int) -> list[EventBatch]:
    """Batches closed by watermarks alone."""
    return event_batches(both(ingest, events([]), t_ns, seq=1))


# --- where batches end


def test_a_batch_closed_by_count_holds_all_events_of_its_last_time() -> None:
    times = [T0_NS + i * MS for i in range(99)] + [T0_NS + 99 * MS] * 3 + [T0_NS + 100 * MS]
    (batch,) = event_batches(both(stage(batch="count", count=100), events(times), T0_NS + 101 * MS))
    assert (batch.t_start_ns, batch.t_ns) == (T0_NS, T0_NS + 99 * MS + 1)
    assert batch.n_events == 102


def test_a_batch_waits_until_no_tie_can_come() -> None:
    ingest = stage(batch="count", count=100)
    times = [T0_NS + i * MS for i in range(100)]
    assert both(ingest, events(times), times[-1]) == []
    (batch,) = closed_by(ingest, times[-1] + 1)
    assert batch.n_events == 100


def test_batches_by_time_lie_on_the_grid_of_the_period() -> None:
    times = [T0_NS + 3 * MS, T0_NS + 14 * MS]
    batches = event_batches(both(stage(batch="time"), events(times), T0_NS + 25 * MS))
    assert [b.t_start_ns - T0_NS for b in batches] == [3 * MS, 10 * MS]
    assert [b.t_ns - T0_NS for b in batches] == [10 * MS, 20 * MS]
    assert [b.n_events for b in batches] == [1, 1]


def test_whichever_is_first_closes_the_batch() -> None:
    times = [T0_NS + i * MS // 20 for i in range(150)] + [T0_NS + 30 * MS]
    batches = event_batches(both(stage(batch="first", count=100), events(times), T0_NS + 31 * MS))
    by_count = T0_NS + 99 * MS // 20 + 1
    assert [b.t_ns for b in batches] == [by_count, by_count + 10 * MS, by_count + 20 * MS]
    assert [b.n_events for b in batches] == [100, 50, 0]


def test_a_silent_scene_gives_empty_batches_for_a_second_and_then_none() -> None:
    batches = event_batches(both(stage(), events([T0_NS, T0_NS + 5000 * MS]), T0_NS + 5011 * MS))
    assert [b.n_events for b in batches] == [1] + [0] * 99 + [1]
    assert batches[-1].t_start_ns == T0_NS + 5000 * MS


def test_a_closed_batch_comes_as_stereo_events_and_imu_of_one_seq() -> None:
    out = both(stage(), edges(seconds=0.05), T0_NS + 50 * MS)
    stereo, batch, imu = out[-3:]
    assert isinstance(stereo, StereoBatch) and isinstance(batch, EventBatch) and isinstance(imu, ImuSamples)
    assert stereo.seq == batch.seq == imu.batch_seq == len(out) // 3 - 1
    assert stereo.t_ns == batch.t_ns == imu.batch_t_ns == imu.event_t_ns
    for a, b in ((stereo.x, batch.x), (stereo.y, batch.y), (stereo.age, batch.age), (stereo.p, batch.p)):
        assert np.array_equal(a, b)
    assert len(batch.x) > 10


def test_surfaces_hold_the_events_before_the_end_and_no_later_ones() -> None:
    e = edges(seconds=0.05)
    out = both(stage(), e, T0_NS + 50 * MS)
    stereo = [m for m in out if isinstance(m, StereoBatch)][2]
    entered = e[e.t_ns < stereo.t_ns]
    expected = np.zeros((HEIGHT, WIDTH), np.int64)
    expected[entered.y, entered.x] = -(-(stereo.t_ns - entered.t_ns) // stereo.unit_ns)
    assert np.array_equal(stereo.left_last, expected)
    assert np.array_equal(stereo.right_last, expected)
    assert np.array_equal(stereo.left, stereo.right)
    assert (stereo.left.max(axis=0) >= stereo.left_last).all()


def test_the_papers_selection_takes_its_patches_from_the_last_events() -> None:
    e = edges(seconds=0.1, spacing_px=30.0)
    paper, burst = (
        event_batches(both(stage(selection=how, period_ms=90.0, count=10**6), e, T0_NS + 95 * MS))[0]
        for how in ("paper", "burst")
    )
    for batch, newest_of_burst in ((paper, True), (burst, False)):
        assert len(batch.x) == 50
        for x, y, p, age in zip(batch.x, batch.y, batch.p, batch.age, strict=True):
            own = e.t_ns[(e.x == x) & (e.y == y) & (e.p == p) & (e.t_ns < batch.t_ns)]
            # Bursts of two events; at most one burst of each polarity in this time.
            assert batch.t_ns - int(age) == (own.max() if newest_of_burst else own.min())


# --- the other camera


def test_a_batch_waits_for_the_right_camera() -> None:
    ingest = stage(max_skew_ms=50.0)
    assert ingest.handle(events([T0_NS]).packet(0, T0_NS + 59 * MS)) == []
    out = event_batches(ingest.handle(watermark(0, T0_NS + 20 * MS, "right")))
    assert [b.t_ns for b in out] == [T0_NS + 10 * MS, T0_NS + 20 * MS]


def test_without_the_right_camera_a_batch_closes_after_the_skew_with_an_alarm() -> None:
    ingest = stage(max_skew_ms=50.0)
    out = event_batches(ingest.handle(events([T0_NS]).packet(0, T0_NS + 61 * MS)))
    assert [b.t_ns for b in out] == [T0_NS + 10 * MS]
    assert ingest.counters["batches.without_right"] == 1
    assert "right camera" in ingest.alarms["camera.right"]
    ingest.handle(watermark(0, T0_NS + 60 * MS, "right"))
    assert ingest.alarms == {}


def test_while_the_left_camera_is_silent_the_right_one_does_not_pile_up() -> None:
    ingest = stage(max_skew_ms=50.0)
    e = edges(seconds=0.2)
    ingest.handle(e.packet(0, T0_NS + 200 * MS, "right"))
    assert "left camera" in ingest.alarms["camera.left"]
    assert len(ingest._right.queue) == (e.t_ns >= T0_NS + 150 * MS).sum()


# --- bad events


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("events.outside", events([T0_NS + MS], x=WIDTH)),
        ("events.outside", events([T0_NS + MS], y=HEIGHT)),
        ("events.polarity", events([T0_NS + MS], p=2)),
        ("events.backwards", events([T0_NS - 1])),
    ],
)
def test_a_bad_event_is_counted_and_dropped_by_itself(name: str, bad: Events) -> None:
    good = events([T0_NS, T0_NS + 2 * MS])
    mixed = Events(
        *(
            np.insert(g, 1, b)
            for g, b in zip(
                (good.x, good.y, good.t_ns, good.p), (bad.x[0], bad.y[0], bad.t_ns[0], bad.p[0]), strict=True
            )
        )
    )
    ingest = stage()
    both(ingest, mixed, T0_NS + 2 * MS)
    (batch,) = closed_by(ingest, T0_NS + 11 * MS)
    assert batch.n_events == 2
    assert {k: v for k, v in ingest.counters.items() if v} == {name: 2, "events": 4, "batches": 1}


def test_an_event_below_an_earlier_watermark_is_backwards() -> None:
    ingest = stage()
    both(ingest, events([T0_NS]), T0_NS + 5 * MS)
    both(ingest, events([T0_NS + 4 * MS, T0_NS + 6 * MS]), T0_NS + 6 * MS, seq=1)
    assert ingest.counters["events.backwards"] == 2


def test_a_watermark_below_the_last_event_is_raised_to_it() -> None:
    ingest = stage()
    both(ingest, events([T0_NS, T0_NS + 9 * MS]), T0_NS)
    ingest.handle(imu_packet(0, [T0_NS]))
    (samples,) = ingest.handle(imu_packet(1, [T0_NS + 1]))
    assert isinstance(samples, ImuSamples)
    assert samples.event_t_ns == T0_NS + 9 * MS


def test_columns_of_different_length_and_unknown_cameras_are_counted() -> None:
    ingest = stage()
    good = events([T0_NS, T0_NS + 1])
    assert ingest.handle(EventPacket(0, T0_NS, "left", good.x[:1], good.y, good.t_ns, good.p)) == []
    assert ingest.handle(good.packet(0, camera="middle")) == []
    bad_imu = imu_packet(0, [T0_NS, T0_NS + 1], accel=np.zeros((1, 3)))
    assert ingest.handle(bad_imu) == []
    assert ingest.handle(imu_packet(0, [])) == []
    assert ingest.counters == {"packets.malformed": 3, "packets.camera": 1}


# --- filters


def test_a_hot_pixel_is_dropped_and_its_neighbours_are_kept() -> None:
    hot = events([T0_NS + i * MS for i in range(1000)])
    ingest = stage(hot_pixel_hz=100.0, batch="count")
    ingest.handle(hot.packet(0))
    assert ingest.counters["events.hot"] == 900
    ingest.handle(events([T0_NS + 1000 * MS], x=11).packet(1))
    ingest.handle(events([T0_NS + 1001 * MS]).packet(2))
    assert ingest.counters["events.hot"] == 901


def test_a_hot_pixel_that_cools_down_is_heard_again() -> None:
    ingest = stage(hot_pixel_hz=100.0, batch="count")
    ingest.handle(events([T0_NS + i * MS for i in range(1000)]).packet(0))
    ingest.handle(events([T0_NS + 3000 * MS]).packet(1))
    assert ingest.counters["events.hot"] == 900


def test_lonely_events_are_background() -> None:
    ingest = stage(background_ms=5.0)
    ingest.handle(events([T0_NS], x=10).packet(0))
    ingest.handle(events([T0_NS + 4 * MS], x=11).packet(1))
    ingest.handle(events([T0_NS + 10 * MS], x=10).packet(2))
    assert ingest.counters["events.background"] == 2


# --- packets


def test_a_duplicated_packet_is_counted_and_dropped() -> None:
    ingest = stage()
    packet = events([T0_NS]).packet(0)
    ingest.handle(packet)
    assert ingest.handle(packet) == []
    assert ingest.counters["packets.duplicate"] == 1
    ingest.handle(watermark(0, T0_NS + 20 * MS, "right"))
    (batch,) = event_batches(ingest.handle(watermark(1, T0_NS + 11 * MS, "left")))
    assert batch.n_events == 1


def test_reordered_packets_are_put_right() -> None:
    ingest = stage()
    ingest.handle(watermark(0, T0_NS + 20 * MS, "right"))
    for seq, ms in ((0, 0), (2, 4), (1, 2), (3, 6)):
        ingest.handle(events([T0_NS + ms * MS]).packet(seq))
    (batch,) = event_batches(ingest.handle(watermark(4, T0_NS + 11 * MS, "left")))
    assert batch.n_events == 4
    assert dict(ingest.counters) == {"events": 4, "batches": 1}


def test_a_missing_packet_is_given_up_after_a_while_and_is_late_then() -> None:
    ingest = stage()
    ingest.handle(watermark(0, T0_NS + 50 * MS, "right"))
    ingest.handle(events([T0_NS]).packet(0))
    assert ingest.handle(events([T0_NS + 12 * MS]).packet(3)) == []
    (batch, *_) = event_batches(ingest.handle(events([T0_NS + 21 * MS]).packet(4)))
    assert batch.n_events == 1
    assert ingest.counters["packets.gap"] == 2
    assert ingest.handle(events([T0_NS + 2 * MS]).packet(1)) == []
    assert ingest.counters["packets.late"] == 1


def test_a_restarted_publisher_is_heard_at_once() -> None:
    ingest = stage()
    for seq in range(3):
        both(ingest, events([T0_NS + seq * MS]), T0_NS + seq * MS, seq)
    (batch,) = event_batches(both(ingest, events([T0_NS + 5 * MS]), T0_NS + 12 * MS, seq=0))
    assert batch.n_events == 4
    assert ingest.counters["packets.restart"] == 2


@pytest.mark.parametrize("back_ms", [20_000, 990])
def test_a_restarted_clock_starts_all_over(back_ms: int) -> None:
    start = T0_NS + 30_000 * MS
    ingest = stage()
    for seq in range(3):
        both(ingest, events([start + seq * MS]), start + seq * MS, seq)
    again = start - back_ms * MS
    both(ingest, events([again]), again, seq=0)
    (batch,) = closed_by(ingest, again + 10 * MS)
    assert ingest.counters["clock.restart"] >= 1
    assert (batch.seq, batch.t_start_ns, batch.n_events) == (0, again, 1)


def test_events_whose_times_do_not_go_on_are_held_up_to_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("velod.ingest.stream.MAX_QUEUED", 1000)
    ingest = stage()
    both(ingest, events([T0_NS]), T0_NS)
    for seq in range(1, 40):
        ingest.handle(events([T0_NS + 5 * MS] * 100).packet(seq, T0_NS + 5 * MS, "right"))
    assert ingest.counters["events.overflow"] == 1 + 39 * 100 - 1000


# --- IMU


def test_imu_samples_go_out_at_once_on_the_cameras_clock() -> None:
    ingest = IngestStage(settings(), calibration(time_offset_s=0.002))
    packet = imu_packet(0, [T0_NS, T0_NS + 5 * MS])
    (out,) = ingest.handle(packet)
    assert isinstance(out, ImuSamples)
    assert out.sample_t_ns.tolist() == [T0_NS - 2 * MS, T0_NS + 3 * MS]
    assert out.t_ns == T0_NS + 3 * MS
    assert np.array_equal(out.accel, packet.accel) and np.array_equal(out.gyro, packet.gyro)
    assert (out.batch_seq, out.batch_t_ns, out.event_t_ns) == (-1, 0, 0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("column", ["accel", "gyro"])
def test_a_sample_that_is_not_finite_is_dropped(value: float, column: str) -> None:
    ingest = stage()
    packet = imu_packet(0, [T0_NS, T0_NS + 5 * MS, T0_NS + 10 * MS])
    getattr(packet, column)[1, 2] = value
    (out,) = ingest.handle(packet)
    assert isinstance(out, ImuSamples)
    assert out.sample_t_ns.tolist() == [T0_NS, T0_NS + 10 * MS]
    assert ingest.counters == {"imu.nan": 1}


def test_samples_that_go_back_or_repeat_a_time_are_dropped() -> None:
    ingest = stage()
    (out,) = ingest.handle(imu_packet(0, [T0_NS, T0_NS + 5, T0_NS + 5, T0_NS + 3, T0_NS + 6]))
    assert isinstance(out, ImuSamples)
    assert (out.sample_t_ns - T0_NS).tolist() == [0, 5, 6]
    assert ingest.counters == {"imu.backwards": 2}


def test_a_frozen_imu_is_dropped_with_an_alarm_until_it_moves() -> None:
    ingest = stage(imu_frozen_samples=5)
    still = np.ones((8, 3))
    (out,) = ingest.handle(imu_packet(0, T0_NS + np.arange(8) * MS, accel=still, gyro=still))
    assert isinstance(out, ImuSamples)
    assert len(out.sample_t_ns) == 5
    assert ingest.counters == {"imu.frozen": 3}
    assert "repeated" in ingest.alarms["imu.frozen"]
    ingest.handle(imu_packet(1, [T0_NS + 20 * MS]))
    assert ingest.alarms == {}


@pytest.mark.parametrize(
    ("accel", "gyro", "doubt"),
    [
        (9.81, 0.2, ""),
        (3.0, 30.0, ""),  # braking hard upwards, spinning at the end of the range
        (1.0, 0.2, "1.00 m/s^2 over a second: is it in g?"),
        (9.81, 75.0, "75 rad/s over a second: is it in degrees?"),
    ],
)
def test_an_imu_in_other_units_is_doubted_within_two_seconds(accel: float, gyro: float, doubt: str) -> None:
    ingest, rng = stage(), np.random.default_rng(1)
    for i in range(400):
        value = 1e-3 * rng.normal(size=(1, 3))
        sample = imu_packet(
            i, [T0_NS + i * 5 * MS], value + np.array([0.0, 0.0, accel]), value + np.array([gyro, 0.0, 0.0])
        )
        ingest.handle(sample)
        assert i > 150 or not ingest.alarms, "a moment says nothing"
    assert doubt in ingest.alarms.get("imu.units", "")
    assert bool(ingest.alarms) == bool(doubt)


def test_every_batch_ends_after_all_that_was_promised_before_it() -> None:
    ingest, e = stage(), edges(seconds=0.1)
    promised, imu_seq, sent = 0, 0, 0
    for i, start in enumerate(range(0, len(e.x), 70)):
        for camera in ("left", "right"):
            packet = e[start : start + 70].packet(i, camera=camera)
            for batch in event_batches(ingest.handle(packet)):
                assert batch.t_ns > promised
                sent = batch.t_ns
            (now,) = ingest.handle(imu_packet(imu_seq, [packet.t_ns + imu_seq % 2]))
            assert isinstance(now, ImuSamples)
            assert now.batch_t_ns == sent <= now.event_t_ns
            promised, imu_seq = now.event_t_ns, imu_seq + 1
    assert sent > T0_NS + 80 * MS
    assert promised > sent


def test_before_time_zero_nothing_is_promised_that_has_not_come() -> None:
    ingest, e = stage(), edges(seconds=0.05)
    past = 2 * T0_NS
    e = Events(e.x, e.y, e.t_ns - past, e.p)
    out = [*ingest.handle(imu_packet(0, [T0_NS - past])), *both(ingest, e, T0_NS - past + 50 * MS)]
    words = [m for m in out if isinstance(m, ImuSamples)]
    assert words[0].event_t_ns == 0  # nothing heard
    assert len(words) > 3 and all(m.event_t_ns < 0 and m.batch_t_ns < 0 for m in words[1:])


def test_events_that_pass_an_output_are_told_of_at_once() -> None:
    """So that the optimizer knows without waiting for the next samples that no batch ended before its output."""
    ingest, output_ns = stage(period_ms=20.0), 76 * NS_PER_S // 75
    both(ingest, events([T0_NS + MS]), T0_NS + 2 * MS, seq=0)
    ingest.handle(imu_packet(0, [T0_NS + 2 * MS]))
    assert both(ingest, events([T0_NS + 3 * MS]), output_ns - MS, seq=1) == []
    (word,) = both(ingest, events([output_ns]), output_ns + MS, seq=2)
    assert isinstance(word, ImuSamples)
    assert (word.event_t_ns, len(word.sample_t_ns)) == (output_ns + MS, 0)
    assert both(ingest, events([output_ns + MS]), output_ns + 2 * MS, seq=3) == [], "told once"
