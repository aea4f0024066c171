"""Selection event by event: an event is selected the moment the last of its neighbourhood has fired.

The same rule as ``select_burst``, without a batch: each first event of a burst completes the 7x7 of those of the
eight pixels three away whose neighbourhood the edge has now passed. What is selected depends on the stream up to that
event alone. Every cell of a coarse grid rests for a while after a selection, which keeps the image evenly covered and
bounds the rate.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.events.plane_fit import HALF, INNER_AT, REACH, RING_AT, SIZE, WIDE_SIZE, fit_plane, rms_px
from velod.events.sae import NEVER, enter_last
from velod.events.selection import GOOD, MAX_ASYMMETRY, SYMMETRY_NOISE
from velod.events.surface_clock import EMPTY
from velod.types import I32, I64, PATCH, RING, U8, U16, U32, WIDE


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
    low = max(border_px, REACH)
    age = np.empty(SIZE, np.float64)
    places, stamp, begins = np.empty((3, t_ns.size), np.int32)
    for i in begins[: enter_last(x, y, t_ns, p, last, refractory_ns, epoch_ns, places, stamp, begins)]:
        k, r, c, t = int(p[i]), int(y[i]), int(x[i]), int(stamp[i])
        first[k, r, c] = t
        for dr in range(-REACH, REACH + 1, REACH):
            rm = r - dr
            if rm < low or rm >= h - low:
                continue
            opens = open_ns[row_cell[rm]]
            for dc in range(-REACH, REACH + 1, REACH):
                cm = c - dc
                if cm < low or cm >= w - low or n == len(at) or (dr == 0 and dc == 0):
                    continue
                if t_ns[i] < opens[column_cell[cm]]:
                    continue
                middle = first[k, rm, cm]
                # On a plane whose newest outer neighbour is the arriving event the one opposite to it is the oldest.
                # One branch for all, as each of them would often be mistaken.
                due = (t - middle <= memory_ns // 2) & (first[k, rm - dr, cm - dc] <= middle)
                if not (due & (middle != taken[k, rm, cm])):
                    continue
                if not _symmetric(first[k], rm, cm, t, memory_ns, SYMMETRY_NOISE * time_noise_s * 1e9):
                    continue
                for q in range(SIZE):
                    # The age of the arriving event is 1 ns: 0 is a missing one.
                    a = t + 1 - first[k, rm - HALF + q // PATCH, cm - HALF + q % PATCH]
                    age[q] = a * 1e-9 if a <= memory_ns else 0.0
                left, gx, gy, _, rms, _, _, _ = fit_plane(age, reject_px, rejections, min_neighbours, time_noise_s)
                # A cell that has waited for another rest takes what is merely acceptable.
                waited = t_ns[i] >= opens[column_cell[cm]] + rest_ns
                residual_px = rms_px(rms, gx * gx + gy * gy, time_noise_s)
                if left == 0 or not residual_px < (1.0 if waited else GOOD) * max_rms_px:
                    continue
                at[n, 0], at[n, 1], at[n, 2] = k, rm, cm
                for q in range(WIDE_SIZE):
                    s = first[k, rm - REACH + q // WIDE, cm - REACH + q % WIDE]
                    times_ns[n, q] = s + epoch_ns if s != EMPTY else NEVER
                n += 1
                taken[k, rm, cm] = middle
                opens[column_cell[cm]] = t_ns[i] + rest_ns
    return n


@njit(cache=True, nogil=True)
def _symmetric(surface: I32, r: int, c: int, t: int, memory_ns: int, slack_ns: float) -> bool:
    """Whether opposite outer neighbours lie symmetrically about (r, c) in time, as on a plane; none: oldest.

    ``slack_ns`` of asymmetry is allowed in any case.
    """
    middle = min(t - surface[r, c], memory_ns)
    symmetric = antisymmetric = 0
    for j in range(4):
        dr, dc = REACH * (j // 3 - 1), REACH * (j % 3 - 1)
        a = min(t - surface[r + dr, c + dc], memory_ns) - middle
        b = min(t - surface[r - dr, c - dc], memory_ns) - middle
        symmetric += abs(a + b)
        antisymmetric += abs(a - b)
    return symmetric <= MAX_ASYMMETRY * antisymmetric + slack_ns


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
        for j in range(SIZE):
            patch[i, j] = wide[INNER_AT[j]]
        for j in range(RING):
            ring[i, j] = wide[RING_AT[j]]
        age[i] = wide[WIDE_SIZE // 2]
