"""Cholesky's factor of an information matrix that is zero beyond an envelope, for kernels, in place.

The matrix is the upper triangle of ``U`` (n, n); row i ends before column ``last[i]``. Its size is a multiple of 3,
and so are ``start`` and ``stop`` below. Inner loops go along slices of rows, and their sums may be reordered: that is
what lets the compiler pack them.
"""

from __future__ import annotations

import math

from numba import njit

from velod.events.plane_fit import ANY_ORDER
from velod.types import F64, I64


@njit(cache=True, nogil=True)
def copy(H: F64, end: I64, start: int, n: int, out: F64) -> None:
    """The upper triangle of H from row ``start`` on; beyond the envelope zeros, up to where it may fill up."""
    for i in range(start, n):
        out[i, i : end[i]] = H[i, i : end[i]]
        out[i, end[i] : n] = 0.0


@njit(cache=True, nogil=True, fastmath=ANY_ORDER)
def factorise(U: F64, last: I64, start: int, stop: int) -> bool:
    """H = U^T U in place, rows ``start`` to ``stop``, for H in ``U``. False: not definite.

    Rows before ``start`` are done; those from ``stop`` on become the Schur complement. Three rows at a time: the
    envelope of a row is that of its block, and fills up with that of the rows before, so ``last`` is raised.
    """
    reach = 0
    for k in range(start, stop, 3):
        for i in range(k, k + 3):
            reach = max(reach, last[i])
        last[k : k + 3] = reach
        for i in range(k, k + 3):
            row = U[i, i:reach]
            for p in range(k, i):
                f, done = U[p, i], U[p, i:reach]
                for j in range(row.size):
                    row[j] -= f * done[j]
            if not row[0] > 0.0:
                return False
            scale = 1.0 / math.sqrt(row[0])
            for j in range(row.size):
                row[j] *= scale
        for i in range(k + 3, reach):
            f0, f1, f2 = U[k, i], U[k + 1, i], U[k + 2, i]
            if f0 == 0.0 and f1 == 0.0 and f2 == 0.0:
                continue
            row, u0, u1, u2 = U[i, i:reach], U[k, i:reach], U[k + 1, i:reach], U[k + 2, i:reach]
            for j in range(row.size):
                row[j] -= f0 * u0[j] + f1 * u1[j] + f2 * u2[j]
    return True


@njit(cache=True, nogil=True, fastmath=ANY_ORDER)
def forward(U: F64, last: I64, x: F64, start: int, stop: int) -> None:
    """x <- U^-T x in place, rows ``start`` to ``stop`` of it; those after become the right side of what is left."""
    for i in range(start, stop):
        x[i] /= U[i, i]
        f, rest, row = x[i], x[i + 1 : last[i]], U[i, i + 1 : last[i]]
        for j in range(rest.size):
            rest[j] -= f * row[j]


@njit(cache=True, nogil=True, fastmath=ANY_ORDER)
def backward(U: F64, last: I64, x: F64) -> None:
    """x <- U^-1 x, in place."""
    for i in range(len(x) - 1, -1, -1):
        rest, row, s = x[i + 1 : last[i]], U[i, i + 1 : last[i]], 0.0
        for j in range(rest.size):
            s += row[j] * rest[j]
        x[i] = (x[i] - s) / U[i, i]


@njit(cache=True, nogil=True, fastmath=ANY_ORDER)
def add_covariance(U: F64, last: I64, F: F64, out: F64) -> None:
    """out += F (U^T U)^-1 F^T, for F (r, n), which is overwritten with F U^-1."""
    rows, n = F.shape
    for a in range(rows):
        first = 0
        while first < n and F[a, first] == 0.0:
            first += 1
        forward(U, last, F[a], first, n)
    for a in range(rows):
        for b in range(a, rows):
            ya, yb, s = F[a], F[b], 0.0
            for j in range(n):
                s += ya[j] * yb[j]
            out[a, b] += s
            if a != b:
                out[b, a] += s
