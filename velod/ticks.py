"""Times of outputs: the whole multiples of their period in sensor time."""

from __future__ import annotations

import math

from velod.types import NS_PER_S


def tick_ns(k: int, hz: float) -> int:
    """When the k-th output is, at ``hz`` outputs per second."""
    return k * NS_PER_S // int(hz) if float(hz).is_integer() else int(k * (NS_PER_S / hz))


def tick_after(t_ns: int, hz: float) -> int:
    """The first output later than ``t_ns``."""
    k = int(t_ns * hz / NS_PER_S) - 1
    while tick_ns(k, hz) <= t_ns:
        k += 1
    return k


def spaced_tick_ns(t_ns: int, hz: float, most_hz: float) -> int:
    """The first time at or after ``t_ns`` out of no more than ``most_hz`` a second, which fall on outputs.

    Of more outputs they are every n-th; of fewer, all, with as many times evenly between them.
    """
    every, between = math.ceil(hz / most_hz), max(1, int(most_hz / hz))
    k = tick_after(t_ns - 1, hz * between)
    return tick_ns(-(-k // every) * every, hz * between)
