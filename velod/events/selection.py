"""Which events of a batch are worth a flow and a depth: at most a quota, spread evenly over the image.

Selection is a pure function of the surfaces at the batch's end, the batch's times and its ``seq``. Candidates are
taken from the cells of a coarse grid in turn, in an order drawn from ``seq``, and the expensive test is made only for
those whose turn comes.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from velod.events.plane_fit import HALF, REACH, SIZE, fit_plane, rms_px
from velod.events.sae import age_unit_ns
from velod.events.surface_clock import new_surface
from velod.types import F64, I32, I64, PATCH, U8, U16

DRAWS = 8
"""Candidates tried in a cell before it is the next one's turn."""

GOOD = 0.5
"""Fits with an rms below this share of the gate are taken before the others."""

MAX_ASYMMETRY = 0.5
"""Neighbourhoods less symmetric than this about the event are not worth a fit (0: a plane, 1: half an edge)."""

SYMMETRY_NOISE = 8.0
"""... but for what the time stamps' noise adds to the four sums of it, in its standard deviations."""

U64 = NDArray[np.uint64]

PAPER_MIN_NEIGHBOURS = 16
"""Sec. V-A, rule 2: more than 15 neighbours in the 5x5 window."""


def select_burst(
    first: I32,
    taken: I32,
    encoded: U16,
    t_start_ns: int,
    t_end_ns: int,
    *,
    memory_ns: int,
    reject_px: float,
    rejections: int,
    min_neighbours: int,
    max_rms_px: float,
    border_px: int,
    quota: int,
    seq: int,
    time_noise_s: float = 0.0,
) -> tuple[U16, U16, U8]:
    """First events of bursts whose edge has just passed the whole of their neighbourhood.

    An event itself comes when its edge has crossed half of the neighbourhood; the plane can be fitted without bias
    only once the other half has fired too. So an event is selected in the batch that completes its 7x7: the newest of
    its outer same-polarity neighbours on ``first`` (2, h, w), lies in [t_start_ns, t_end_ns), and a plane
    leaves ``min_neighbours`` of the inner 25 after rejection (see ``fit_plane``) and ``rms_px`` below ``max_rms_px``.
    It is at most half the memory old, so it may be older than the batch. Time stamps have an error of
    ``time_noise_s``.

    What the quota leaves room for are events with a 5x5 alone: completed in the time before that is as long as the
    batch where edges are too short or too curved for a 7x7, at once where they are too slow for one to fit into the
    memory.

    ``encoded`` is ``encode_ages(first, t_end_ns, memory_ns)``. ``taken`` (2, h, w) holds the stamps selected before:
    those are skipped, and the new ones are entered.

    Returns columns x, y, p in the order of the surface (p, y, x).
    """
    unit_ns = age_unit_ns(memory_ns)
    span = -((t_start_ns - t_end_ns) // unit_ns)
    oldest = memory_ns // 2 // unit_ns
    border_px = max(border_px, REACH)
    slack = SYMMETRY_NOISE * time_noise_s * 1e9 / unit_ns
    chosen = np.empty(0, np.int32)
    for reach_px, since, until in ((REACH, span, 0), (HALF, 2 * span, span)):
        room = quota - len(chosen)
        if room > 0:
            mask, marks = _new_mask(first)
            _mark_passed(encoded, border_px, reach_px, oldest, since, until, oldest - span, slack, mask)
            more = _choose(
                first, marks, t_end_ns, memory_ns, room, seq,
                True, reject_px, rejections, min_neighbours, max_rms_px, time_noise_s, taken,
            )  # fmt: skip
            taken.reshape(-1)[more] = first.reshape(-1)[more]
            chosen = np.concatenate([chosen, more])
    return _columns(chosen, first)


def select_paper(
    last: I32,
    t_start_ns: int,
    t_end_ns: int,
    *,
    memory_ns: int,
    time_share: float,
    border_px: int,
    quota: int,
    seq: int,
) -> tuple[U16, U16, U8]:
    """The culling rules of Sec. V-A on the unfiltered surface ``last`` (2, h, w).

    Kept are events in [t_start_ns, t_end_ns) that are (1) ``border_px`` inside, (2) have more than 15 neighbours
    and (3) differ from the neighbours' mean time by at most ``time_share`` of the batch's duration.
    """
    mask, marks = _new_mask(last)
    border_px = max(border_px, REACH)
    inside = np.s_[:, border_px:-border_px, border_px:-border_px]
    mask[inside] = (last[inside] >= t_start_ns) & (last[inside] < t_end_ns)
    none_taken = new_surface(*last.shape[1:])
    chosen = _choose(
        last, marks, t_end_ns, memory_ns, quota, seq,
        False, time_share * (t_end_ns - t_start_ns) * 1e-9, 0, PAPER_MIN_NEIGHBOURS, math.inf, 0.0, none_taken,
    )  # fmt: skip
    return _columns(chosen, last)


def cell_side_px(height: int, width: int, quota: int) -> int:
    """Side of the coarse grid's cells: about as many cells as events wanted."""
    return max(1, round(math.sqrt(height * width / quota)))


def _new_mask(surface: I32) -> tuple[U8, U64]:
    """Zeros of the shape of ``surface``, a byte each, and the same memory eight at a time, with as many more."""
    marks = np.zeros(-(-surface.size // 8), np.uint64)
    return marks.view(np.uint8)[: surface.size].reshape(surface.shape), marks


def _columns(chosen: I32, surface: I32) -> tuple[U16, U16, U8]:
    _, h, w = surface.shape
    p, rest = np.divmod(np.sort(chosen), h * w)
    y, x = np.divmod(rest, w)
    return x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8)


def _choose(
    surface: I32,
    marks: U64,
    t_end_ns: int,
    memory_ns: int,
    quota: int,
    seq: int,
    burst: bool,
    tolerance: float,
    rejections: int,
    min_neighbours: int,
    max_rms_px: float,
    time_noise_s: float,
    taken: I32,
) -> I32:
    """Flat indices into ``surface`` of at most ``quota`` events out of those marked (see ``_new_mask``).

    ``tolerance`` is that of the rule: ``reject_px`` for bursts, seconds about the neighbours' mean for the paper's.
    """
    _, h, w = surface.shape
    cell_px = cell_side_px(h, w, quota)
    columns = -(-w // cell_px)
    index = np.empty(surface.size, np.int32)
    cell_end = np.zeros(columns * -(-h // cell_px) + 1, np.int32)
    _candidates(surface, taken, marks, cell_px, columns, index, cell_end)
    chosen = np.empty(quota, np.int32)
    n = _take_in_turn(
        surface, t_end_ns, memory_ns, burst, tolerance, rejections, min_neighbours,
        max_rms_px, time_noise_s, seq, index, cell_end, chosen,
    )  # fmt: skip
    return chosen[:n]


@njit(cache=True, nogil=True)
def _mark_passed(
    age: U16,
    border_px: int,
    reach_px: int,
    oldest: int,
    since: int,
    until: int,
    slow: int,
    slack: float,
    mask: U8,
) -> None:
    """Mark pixels whose eight neighbours ``reach_px`` away lie symmetrically about them in time, as on a plane.

    A filter that vectorises, and spares most of the fits. The pixel's ``age`` must be below ``oldest``, that of its
    newest outer neighbour below ``since`` and at least ``until``, or any where the edge takes more than ``slow`` from
    the middle to ``REACH``; all in encoded steps, of which 0 counts as oldest. ``slack`` of asymmetry is allowed
    in any case.
    """
    _, h, w = age.shape
    # Single precision holds the sums of a few steps exactly, in lanes half as wide as those of integers would be.
    oldest_, since_, until_ = np.float32(oldest), np.float32(since), np.float32(until)
    slow_, slack_ = np.float32(slow) * np.float32(reach_px), np.float32(slack)
    west, east = border_px - reach_px, border_px + reach_px
    n = w - 2 * border_px
    for k in range(2):
        for r in range(border_px, h - border_px):
            up, row, down = age[k, r - reach_px], age[k, r], age[k, r + reach_px]
            marks = mask[k, r, border_px : w - border_px]
            w0, c0, e0 = row[west:], row[border_px:], row[east:]
            nw, n0, ne = up[west:], up[border_px:], up[east:]
            sw, s0, se = down[west:], down[border_px:], down[east:]
            for i in range(n):
                t = _oldest_if_none(c0[i])
                a, b = _oldest_if_none(w0[i]) - t, _oldest_if_none(e0[i]) - t
                c, d = _oldest_if_none(n0[i]) - t, _oldest_if_none(s0[i]) - t
                e, f = _oldest_if_none(nw[i]) - t, _oldest_if_none(se[i]) - t
                g, j = _oldest_if_none(ne[i]) - t, _oldest_if_none(sw[i]) - t
                symmetric = abs(a + b) + abs(c + d) + abs(e + f) + abs(g + j)
                antisymmetric = abs(a - b) + abs(c - d) + abs(e - f) + abs(g - j)
                plane = symmetric <= np.float32(MAX_ASYMMETRY) * antisymmetric + slack_
                newest = min(min(min(a, b), min(c, d)), min(min(e, f), min(g, j)))
                passed = newest + t
                waited = (passed >= until_) | (np.float32(REACH) * (t - passed) > slow_)
                marks[i] = np.uint8(plane & (t < oldest_) & (passed < since_) & waited)


@njit(cache=True, nogil=True, inline="always")
def _oldest_if_none(age: np.uint16) -> np.float32:
    return np.float32(np.uint16(age - np.uint16(1)))


@njit(cache=True, nogil=True)
def _candidates(surface: I32, taken: I32, marks: U64, cell_px: int, columns: int, index: I32, cell_end: I32) -> None:
    """Flat indices of marked and untaken stamps, sorted by cell: cell c is index[cell_end[c] : cell_end[c + 1]].

    ``marks`` as of ``_new_mask``. What is found is written whether it counts or not, and overwritten if not: a branch
    would be mistaken too often.
    """
    _, h, w = surface.shape
    stamp, stamp_taken = surface.reshape(-1), taken.reshape(-1)
    word = np.empty(marks.size, np.int32)
    n = 0
    for i in range(marks.size):
        word[n] = i
        n += marks[i] != 0
    found, cell = np.empty(surface.size + 1, np.int32), np.empty(surface.size + 1, np.int32)
    m = 0
    for i in word[:n]:
        for j in range(8):
            found[m] = 8 * i + j
            m += int(marks[i] >> np.uint64(8 * j) & np.uint64(1))
    row_cell = np.arange(2 * h) % h // cell_px * columns
    column_cell = np.arange(w) // cell_px
    n = 0
    for at in found[:m]:
        r = np.uint32(at) // np.uint32(w)
        found[n] = at
        cell[n] = row_cell[r] + column_cell[at - r * w]
        n += stamp[at] != stamp_taken[at]
    for c in cell[:n]:
        cell_end[c + 1] += 1
    for i in range(1, cell_end.size):
        cell_end[i] += cell_end[i - 1]
    fill = cell_end[:-1].copy()
    for i in range(n):
        index[fill[cell[i]]] = found[i]
        fill[cell[i]] += 1


@njit(cache=True, nogil=True)
def _take_in_turn(
    surface: I32,
    t_end_ns: int,
    memory_ns: int,
    burst: bool,
    tolerance: float,
    rejections: int,
    min_neighbours: int,
    max_rms_px: float,
    time_noise_s: float,
    seq: int,
    index: I32,
    cell_end: I32,
    chosen: I32,
) -> int:
    """A candidate from each cell in turn, good ones before acceptable ones, until the quota or all are exhausted."""
    _, h, w = surface.shape
    cells = np.flatnonzero(cell_end[1:] > cell_end[:-1])
    open_cells = cells.size
    state = _mix(np.uint64(seq))
    top = cell_end[1:].copy()
    age = np.empty(SIZE, np.float64)
    reserve = np.empty_like(chosen)
    n = 0
    n_reserve = 0
    while open_cells > 0 and n < chosen.size:
        # The cells of one round in random order: a last, incomplete round must not favour the top of the image.
        state = _shuffle(cells, open_cells, state)
        still_open = 0
        for i in range(open_cells):
            cell = cells[i]
            for _ in range(min(DRAWS, top[cell] - cell_end[cell])):
                state = _mix(state)
                flat = _draw(index, cell_end[cell], top[cell], state)
                top[cell] -= 1
                k, r, c = flat // (h * w), flat // w % h, flat % w
                _ages(surface[k], r, c, t_end_ns, memory_ns, age)
                if burst:
                    residual_px = _plane_rms_px(age, tolerance, rejections, min_neighbours, time_noise_s)
                else:
                    residual_px = 0.0 if _obeys_paper(age, min_neighbours, tolerance) else math.inf
                if not residual_px < max_rms_px:
                    continue
                if residual_px < GOOD * max_rms_px and n < chosen.size:
                    chosen[n] = flat
                    n += 1
                elif n_reserve < reserve.size:
                    reserve[n_reserve] = flat
                    n_reserve += 1
                break
            if top[cell] > cell_end[cell]:
                cells[still_open] = cell
                still_open += 1
        open_cells = still_open
    for i in range(min(n_reserve, chosen.size - n)):
        chosen[n] = reserve[i]
        n += 1
    return n


@njit(cache=True, nogil=True)
def _shuffle(cells: I64, n: int, state: np.uint64) -> np.uint64:
    """Put the first n into random order (Fisher-Yates); the state after that."""
    for i in range(n - 1, 0, -1):
        state = _mix(state)
        j = _below(state, i + 1)
        cells[i], cells[j] = cells[j], cells[i]
    return state


@njit(cache=True, nogil=True, inline="always")
def _draw(index: I32, begin: int, end: int, state: np.uint64) -> int:
    """One of index[begin:end] at random, overwritten by the last of them: what is left is index[begin : end - 1]."""
    j = begin + _below(state, end - begin)
    flat: int = index[j]
    index[j] = index[end - 1]
    return flat


@njit(cache=True, nogil=True, inline="always")
def _mix(state: np.uint64) -> np.uint64:
    """A step of splitmix64 (Steele, Lea, Flood 2014)."""
    z = state + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True, nogil=True, inline="always")
def _below(state: np.uint64, n: int) -> int:
    """A number in [0, n) from the state's upper half."""
    return int((state >> np.uint64(32)) * np.uint64(n) >> np.uint64(32))


@njit(cache=True, nogil=True)
def _ages(surface: I32, r: int, c: int, t_end_ns: int, memory_ns: int, age: F64) -> None:
    """Ages in s of the 5x5 neighbourhood, 0 where older than the memory."""
    for j in range(SIZE):
        a = t_end_ns - surface[r - HALF + j // PATCH, c - HALF + j % PATCH]
        age[j] = a * 1e-9 if 0 < a <= memory_ns else 0.0


@njit(cache=True, nogil=True)
def _plane_rms_px(age: F64, reject_px: float, rejections: int, min_neighbours: int, time_noise_s: float) -> float:
    """How well one plane explains the neighbourhood, px; inf where none does."""
    left, gx, gy, _, rms, _, _, _ = fit_plane(age, reject_px, rejections, min_neighbours, time_noise_s)
    return rms_px(rms, gx * gx + gy * gy, time_noise_s) if left > 0 else math.inf


@njit(cache=True, nogil=True)
def _obeys_paper(age: F64, min_neighbours: int, spread_s: float) -> bool:
    """Sec. V-A, rules 2 and 3: enough neighbours, and the event within ``spread_s`` of their mean time."""
    n = 0
    total = 0.0
    for j in range(SIZE):
        if age[j] > 0.0 and j != SIZE // 2:
            n += 1
            total += age[j]
    return n >= min_neighbours and abs(age[SIZE // 2] - total / n) <= spread_s
