"""Latency percentiles, the age of data, and sequence gaps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from velod.runtime.measure import GapCounter, LatencyRing, SensorClock


def seen(window: int, *seqs: int) -> GapCounter:
    gaps = GapCounter(window)
    for seq in seqs:
        gaps.see(seq)
    return gaps


def test_percentiles_are_numpy_s_in_milliseconds() -> None:
    ring = LatencyRing()
    for ns in range(1_000_000, 101_000_000, 1_000_000):
        ring.add(ns)
    assert ring.percentiles() == pytest.approx(tuple(np.percentile(np.arange(1, 101), (50, 99))))


def test_only_the_newest_samples_count() -> None:
    ring = LatencyRing(capacity=4)
    for ms in (1000, 1000, 1, 1, 1, 1):
        ring.add(ms * 1_000_000)
    assert ring.percentiles() == (1.0, 1.0)


def test_no_sample_no_percentile() -> None:
    ring = LatencyRing()
    ring.add(5)
    ring.clear()
    assert ring.percentiles() is None


def test_an_unbroken_stream_has_no_gaps_wherever_it_starts() -> None:
    assert seen(0, 17, 18, 19).lost == 0


def test_missing_messages_are_counted_at_once_in_an_ordered_stream() -> None:
    assert seen(0, 0, 1, 4, 5).lost == 2


def test_a_message_that_was_overtaken_is_not_lost() -> None:
    assert seen(4, 0, 2, 1, 4, 3, 5, 6, 7, 8, 9, 10, 11).lost == 0


def test_a_missing_message_is_lost_once_it_is_out_of_the_window() -> None:
    assert seen(4, 0, 2, 3, 4, 5).lost == 0
    assert seen(4, 0, 2, 3, 4, 5, 6).lost == 1


def test_a_large_jump_counts_everything_but_the_window() -> None:
    assert seen(4, 0, 1000).lost == 995


def test_a_publisher_that_starts_anew_is_no_gap() -> None:
    gaps = seen(0, 5, 6, 0, 1, 2)
    assert (gaps.lost, gaps.restarts) == (0, 1)


def test_a_straggler_from_long_ago_is_no_gap() -> None:
    gaps = seen(4, *range(100), 10, 12, 100, 101)
    assert (gaps.lost, gaps.restarts) == (0, 0)


def test_a_forgotten_stream_starts_anywhere_and_keeps_its_losses() -> None:
    gaps = seen(4, 0, 50)
    before = gaps.lost
    gaps.forget()
    for seq in range(10):
        gaps.see(seq)
    assert gaps.lost == before == 45


MS, HOST_NS = 1_000_000, 1_700_000_000_000_000_000


def listening(delays_ms: list[float], period_ms: int = 10) -> SensorClock:
    """A clock that heard of one moment of the sensor every period, with these delays."""
    clock = SensorClock()
    for k, delay_ms in enumerate(delays_ms):
        clock.heard(k * period_ms * MS, HOST_NS + k * period_ms * MS + round(delay_ms * MS))
    return clock


def test_an_age_counts_from_the_least_delay_that_was_seen() -> None:
    clock = listening([7.0, 2.0, 9.0, 4.0])
    # sensor time 30 ms arrived 4 ms late, of which 2 ms count as none
    assert clock.age_ms(30 * MS, HOST_NS + 34 * MS) == pytest.approx(2.0, abs=0.01)
    assert math.isnan(SensorClock().age_ms(0, HOST_NS))


def test_a_slow_clock_of_the_sensor_does_not_make_ages_grow() -> None:
    clock = SensorClock()
    for k in range(100_000):  # 50 ppm over 1000 s
        clock.heard(k * 10 * MS, HOST_NS + int(k * 10 * MS * (1 + 5e-5)) + 2 * MS)
    assert clock.age_ms(k * 10 * MS, HOST_NS + int(k * 10 * MS * (1 + 5e-5)) + 5 * MS) == pytest.approx(3.0, abs=0.1)


def test_a_sensor_clock_that_is_set_anew_is_followed_either_way() -> None:
    for jump_ns in (-3600 * 10**9, 3600 * 10**9):
        clock = listening([2.0] * 5)
        t_ns = 4000 * 10**9 + jump_ns
        clock.heard(t_ns, HOST_NS)
        assert clock.age_ms(t_ns, HOST_NS + 3 * MS) == pytest.approx(3.0)
