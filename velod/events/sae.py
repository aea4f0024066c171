"""Surfaces of active events (SAE): the newest event times per pixel and polarity (T of Eq. 5).

Two surfaces are kept of each camera. An edge fires several events per pixel, so ``first`` holds the first event
of the newest burst (what the plane fit needs), and ``last`` the last event of any kind (what the time surfaces of
block matching need). Stamps are those of a ``SurfaceClock``: int32 ns since its epoch, ``EMPTY`` where nothing has
happened; a time that they are compared with is taken there by ``SurfaceClock.stamp``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from velod.events.plane_fit import HALF, REACH, RING_COLUMN, RING_ROW, SIZE
from velod.types import I32, I64, PATCH, U8, U16, U32

NEVER = -(2**62)
"""A time before all others, and far from int64 overflow in differences."""

MAX_U16 = 65_535

BLOCK = 1024
"""Events that are entered into one surface before the other one's turn comes."""


@njit(cache=True, nogil=True)
def update_sae(
    x: U16, y: U16, t_ns: I64, p: U8, first: I32, last: I32, refractory_ns: int, epoch_ns: int = 0
) -> None:
    """Enter events, in time order, into ``first`` and ``last`` (2, h, w), in place.

    An event sooner than ``refractory_ns`` after the last one of its pixel and polarity belongs to that one's burst
    and updates only ``last``. Coordinates and polarities must have been checked, and times fit ``epoch_ns``.
    """
    # One surface at a time: stores into two by turns take twice as long.
    n = min(t_ns.size, BLOCK)
    at, stamp, begins = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    flat = first.reshape(-1)
    for start in range(0, t_ns.size, BLOCK):
        b = slice(start, start + BLOCK)
        m = enter_last(x[b], y[b], t_ns[b], p[b], last, refractory_ns, epoch_ns, at, stamp, begins)
        for i in begins[:m]:
            flat[np.uint32(at[i])] = stamp[i]


@njit(cache=True, nogil=True)
def enter_last(
    x: U16,
    y: U16,
    t_ns: I64,
    p: U8,
    last: I32,
    refractory_ns: int,
    epoch_ns: int,
    at: I32,
    stamp: I32,
    begins: I32,
) -> int:
    """Enter events, in time order, into ``last`` (2, h, w); writes which of them begin a burst to ``begins`` (n,).

    Their flat places in ``last`` are written to ``at`` (n,) and their stamps to ``stamp`` (n,), in a loop of its own,
    which vectorises. Returns how many begin one.
    """
    _, h, w = last.shape
    for i in range(t_ns.size):
        at[i] = (np.int32(p[i]) * np.int32(h) + np.int32(y[i])) * np.int32(w) + np.int32(x[i])
        stamp[i] = np.int32(t_ns[i] - epoch_ns)
    flat = last.reshape(-1)
    n = 0
    for i in range(t_ns.size):
        # Unsigned, so that nobody looks whether it counts from the end.
        place = np.uint32(at[i])
        begins[n] = i
        n += stamp[i] - flat[place] >= refractory_ns
        flat[place] = stamp[i]
    return n


def age_unit_ns(memory_ns: int) -> int:
    """The finest whole number of ns in which every age up to ``memory_ns`` fits into 16 bits."""
    return math.ceil(memory_ns / MAX_U16)


_SHIFT = 46
"""Divisions by a step are multiplications by 2^46 / step: exact while memory^2 / MAX_U16 < 2^46, up to 2 s."""


@njit(cache=True, nogil=True, inline="always")
def _steps(stamp_ns: int, t_end_ns: int, memory_ns: int, unit_ns: int, per_unit: np.uint64) -> np.uint16:
    age = min(max(t_end_ns - stamp_ns, 0), memory_ns + 1)
    within = age if age <= memory_ns else 0
    # Integer division does not vectorise.
    return np.uint16(np.uint64(within + unit_ns - 1) * per_unit >> np.uint64(_SHIFT))


@njit(cache=True, nogil=True, inline="always")
def _per_unit(unit_ns: int) -> np.uint64:
    return np.uint64((1 << _SHIFT) // unit_ns + 1)


@njit(cache=True, nogil=True)
def _encode_ages(stamp: I32, t_end_ns: int, memory_ns: int, unit_ns: int, out: U16) -> None:
    per_unit = _per_unit(unit_ns)
    for i in range(stamp.size):
        out[i] = _steps(stamp[i], t_end_ns, memory_ns, unit_ns, per_unit)


@njit(cache=True, nogil=True)
def _encode_newest(a: I32, b: I32, t_end_ns: int, memory_ns: int, unit_ns: int, out: U16) -> None:
    per_unit = _per_unit(unit_ns)
    for i in range(a.size):
        out[i] = _steps(max(a[i], b[i]), t_end_ns, memory_ns, unit_ns, per_unit)


def encode_ages(stamp: I32, t_end_ns: int, memory_ns: int) -> U16:
    """Ages before ``t_end_ns`` in steps of ``age_unit_ns(memory_ns)``, rounded up; 0 beyond the memory.

    ``stamp``: C-contiguous int32 of any shape, ns of the clock that ``t_end_ns`` is of; the result has the same
    shape. Stamps at or after ``t_end_ns`` give 0.
    """
    out = np.empty(stamp.shape, np.uint16)
    _encode_ages(stamp.reshape(-1), t_end_ns, memory_ns, age_unit_ns(memory_ns), out.reshape(-1))
    return out


def encode_newest(stamp: I32, t_end_ns: int, memory_ns: int) -> U16:
    """``encode_ages`` of the newest stamp of either polarity, (h, w), for a surface (2, h, w)."""
    out = np.empty(stamp.shape[1:], np.uint16)
    off, on = stamp.reshape(2, -1)
    _encode_newest(off, on, t_end_ns, memory_ns, age_unit_ns(memory_ns), out.reshape(-1))
    return out


@njit(cache=True, nogil=True)
def gather_patches(
    surface: I32, x: U16, y: U16, p: U8, t_end_ns: int, memory_ns: int, age: U32, patch: U32, ring: U32
) -> None:
    """Ages (ns before ``t_end_ns``) of the events and of their same-polarity neighbours on ``surface``.

    Writes ``age`` (n,), ``patch`` (n, 25) of the 5x5, row-major, and ``ring`` (n, 24) of the rest of the 7x7; 0 where
    the stamp is older than ``memory_ns``. A ``ring`` without rows is left alone. Events must be at least 2 px inside,
    3 px with a ring.
    """
    for i in range(x.size):
        k, r0, c0 = p[i], np.int64(y[i]) - HALF, np.int64(x[i]) - HALF
        for j in range(SIZE):
            a = t_end_ns - surface[k, r0 + j // PATCH, c0 + j % PATCH]
            patch[i, j] = np.uint32(a) if 0 < a <= memory_ns else np.uint32(0)
        age[i] = patch[i, SIZE // 2]
    for i in range(ring.shape[0]):
        k, r0, c0 = p[i], np.int64(y[i]) - REACH, np.int64(x[i]) - REACH
        for j in range(ring.shape[1]):
            a = t_end_ns - surface[k, r0 + RING_ROW[j], c0 + RING_COLUMN[j]]
            ring[i, j] = np.uint32(a) if 0 < a <= memory_ns else np.uint32(0)
