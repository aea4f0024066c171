"""Outputs are the whole multiples of their period, at any time and rate; batches that are spaced end with them."""

import hypothesis.strategies as st
from hypothesis import given

from velod.ticks import spaced_tick_ns, tick_after, tick_ns
from velod.types import NS_PER_S

times_ns = st.integers(-(10**18), 2 * 10**18)
rates = st.sampled_from([1.0, 10.0, 30.0, 60.0, 75.0, 77.7, 100.0, 200.0, 1000.0])


@given(times_ns, rates)
def test_the_next_output_is_the_first_one_later(t_ns, hz):
    k = tick_after(t_ns, hz)
    assert tick_ns(k - 1, hz) <= t_ns < tick_ns(k, hz)


@given(times_ns, rates)
def test_spaced_times_come_within_twice_their_least_distance(t_ns, hz):
    """Float times of rates that are no whole number are good to 256 ns at the times of an epoch."""
    end_ns = spaced_tick_ns(t_ns, hz, 75.0)
    after_ns = spaced_tick_ns(end_ns + 1, hz, 75.0)
    assert 0 <= end_ns - t_ns <= 2.0 * NS_PER_S / 75.0 + 1000
    assert NS_PER_S / 75.0 - 1000 <= after_ns - end_ns <= 2.0 * NS_PER_S / 75.0 + 1000


@given(times_ns, st.sampled_from([75.0, 77.7, 100.0, 200.0, 1000.0]))
def test_spaced_times_are_outputs_where_there_are_as_many(t_ns, hz):
    end_ns = spaced_tick_ns(t_ns, hz, 75.0)
    assert tick_ns(tick_after(end_ns - 1, hz), hz) == end_ns


@given(st.integers(0, 10**9), st.sampled_from([1.0, 10.0, 30.0]))
def test_fewer_outputs_than_spaced_times_are_all_among_them(k, hz):
    assert spaced_tick_ns(tick_ns(k, hz), hz, 75.0) == tick_ns(k, hz)
