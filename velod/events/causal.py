"""Selection event by event: an event is selected the moment the last of its neighbourhood has fired.

The same rule as ``select_burst``, without a batch: each first event of a burst completes the 7x7 of those of the
eight pixels three away whose neighbourhood the edge has now passed. What is selected depends on the stream up to that
event alone. Every cell of a coarse grid rests for a while after a selection, which keeps the image evenly covered and
bounds the rate.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.events.plane_fit import HALF, REACH, SIZE, WIDE_SIZE, fit_plane, rms_px
from velod.events.sae import NEVER, enter_last
from velod.events.selection import GOOD, MAX_ASYMMETRY, SYMMETRY_NOISE
from velod.events.surface_clock import EMPTY
from velod.types import F64, I32, I64, PATCH, RING, U8, U16, U32, WIDE


@njit(cache=True, nogil=True)
def enter_and_select(
    x: U16,
    y: U16,
    t_ns: I64,
    p: U8,
    first: I32,
    last: I32,
    refractory_ns: int,
    epoch_ns: int,
    taken: I32,
    open_ns: I64,
    row_cell: I64,
    column_cell: I64,
    rest_ns: int,
    border_px: int,
    memory_ns: int,
    reject_px: float,
    rejections: int,
    min_neighbours: int,
    max_rms_px: float,
    time_noise_s: float,
    at: I32,
    times_ns: I64,
    n: int,
) -> int:
    """Enter events into ``first`` and ``last`` as ``update_sae`` does; note what each one completes.

    A neighbourhood is complete when it passes the tests of ``select_burst`` at the arriving event: its middle at most
    half the memory old and not in ``taken`` (2, h, w), symmetric, and one plane through ``min_neighbours``. A cell,
    which ``row_cell`` (h,) and ``column_cell`` (w,) give, takes the next one when ``open_ns`` (rows, columns) says:
    ``rest_ns`` after the last. Surfaces hold ns since ``epoch_ns``, all else is sensor time.

    Writes (p, y, x) of the selected to ``at`` (capacity, 3) and the times of their neighbourhoods to ``times_ns``
    (capacity, 49), 7x7 row-major, NEVER where none, from row ``n`` on; returns the number of rows then filled. What
    does not fit is not selected.
    """
    _, h, w = first.shape
    low, slack_ns = max(border_px, REACH), SYMMETRY_NOISE * time_noise_s * 1e9
    flat, flat_taken = first.reshape(-1), taken.reshape(-1)
    age = np.empty(SIZE, np.float64)
    places, stamp, begins = np.empty((3, t_ns.size), np.int32)
    for i in begins[: enter_last(x, y, t_ns, p, last, refractory_ns, epoch_ns, places, stamp, begins)]:
        place, r, c, t = int(places[i]), int(y[i]), int(x[i]), int(stamp[i])
        # Unsigned, here and below, so that nobody looks whether it counts from the end.
        flat[np.uint32(place)] = t
        for dr in range(-REACH, REACH + 1, REACH):
            rm = r - dr
            if rm < low or rm >= h - low:
                continue
            opens = open_ns[np.uint32(row_cell[np.uint32(rm)])]
            for dc in range(-REACH, REACH + 1, REACH):
                cm = c - dc
                if cm < low or cm >= w - low or n == len(at) or (dr == 0 and dc == 0):
                    continue
                cell = np.uint32(column_cell[np.uint32(cm)])
                if t_ns[i] < opens[cell]:
                    continue
                mid = place - dr * w - dc
                middle = flat[np.uint32(mid)]
                # On a plane whose newest outer neighbour is the arriving event the one opposite to it is the oldest.
                # One branch for all, as each of them would often be mistaken.
                due = (t - middle <= memory_ns // 2) & (flat[np.uint32(mid - dr * w - dc)] <= middle)
                if not (due & (middle != flat_taken[np.uint32(mid)])):
                    continue
                if not _symmetric(flat, mid, w, t, memory_ns, slack_ns):
                    continue
                _ages(flat, mid, w, t, memory_ns, age)
                left, gx, gy, _, rms, _, _, _ = fit_plane(age, reject_px, rejections, min_neighbours, time_noise_s)
                # A cell that has waited for another rest takes what is merely acceptable.
                waited = t_ns[i] >= opens[cell] + rest_ns
                residual_px = rms_px(rms, gx * gx + gy * gy, time_noise_s)
                if left == 0 or not residual_px < (1.0 if waited else GOOD) * max_rms_px:
                    continue
                at[n, 0], at[n, 1], at[n, 2] = p[i], rm, cm
                _copy_times(flat, mid, w, epoch_ns, times_ns[n])
                n += 1
                flat_taken[np.uint32(mid)] = middle
                opens[cell] = t_ns[i] + rest_ns
    return n


@njit(cache=True, nogil=True, inline="always")
def _symmetric(flat: I32, mid: int, w: int, t: int, memory_ns: int, slack_ns: float) -> bool:
    """Whether opposite outer neighbours lie symmetrically about ``mid`` in time, as on a plane; none: oldest.

    ``slack_ns`` of asymmetry is allowed in any case.
    """
    middle = min(t - flat[np.uint32(mid)], memory_ns)
    symmetric = antisymmetric = 0
    for step in (REACH * (w + 1), REACH * w, REACH * (w - 1), REACH):
        a = min(t - flat[np.uint32(mid - step)], memory_ns) - middle
        b = min(t - flat[np.uint32(mid + step)], memory_ns) - middle
        symmetric += abs(a + b)
        antisymmetric += abs(a - b)
    return symmetric <= MAX_ASYMMETRY * antisymmetric + slack_ns


@njit(cache=True, nogil=True, inline="always")
def _ages(flat: I32, mid: int, w: int, t: int, memory_ns: int, age: F64) -> None:
    """Ages in s of the 5x5 about ``mid``, 0 where older than the memory; that of an event at ``t`` is 1 ns."""
    for r in range(PATCH):
        row = mid + (r - HALF) * w - HALF
        for c in range(PATCH):
            a = t + 1 - flat[np.uint32(row + c)]
            age[PATCH * r + c] = a * 1e-9 if a <= memory_ns else 0.0


@njit(cache=True, nogil=True, inline="always")
def _copy_times(flat: I32, mid: int, w: int, epoch_ns: int, times_ns: I64) -> None:
    """Times of the 7x7 about ``mid``, NEVER where there is none."""
    for r in range(WIDE):
        row = mid + (r - REACH) * w - REACH
        for c in range(WIDE):
            stamp = flat[np.uint32(row + c)]
            times_ns[WIDE * r + c] = stamp + epoch_ns if stamp != EMPTY else NEVER


def all_open(rows: int, columns: int) -> I64:
    """A grid of cells each of which takes the next event at once."""
    return np.full((rows, columns), NEVER, np.int64)


@njit(cache=True, nogil=True)
def split_ages(times_ns: I64, t_end_ns: int, memory_ns: int, age: U32, patch: U32, ring: U32) -> None:
    """Ages in ns before ``t_end_ns`` of neighbourhoods ``times_ns`` (n, 49), 0 where older than the memory.

    Writes that of the middle to ``age`` (n,), the 5x5 to ``patch`` (n, 25), what is around to ``ring`` (n, 24).
    """
    wide = np.empty(WIDE_SIZE, np.uint32)
    for i in range(len(times_ns)):
        for j in range(WIDE_SIZE):
            a = t_end_ns - times_ns[i, j]
            wide[j] = np.uint32(a if a <= memory_ns else 0)
        for r in range(PATCH):
            for c in range(PATCH):
                patch[i, PATCH * r + c] = wide[WIDE * (r + 1) + 1 + c]
        for j in range(WIDE):
            ring[i, j], ring[i, RING - WIDE + j] = wide[j], wide[WIDE_SIZE - WIDE + j]
        for r in range(PATCH):
            ring[i, WIDE + 2 * r], ring[i, WIDE + 2 * r + 1] = wide[WIDE * (r + 1)], wide[WIDE * (r + 2) - 1]
        age[i] = wide[WIDE_SIZE // 2]
