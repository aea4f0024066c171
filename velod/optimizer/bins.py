"""The flows of a batch compressed into small informations, one for every few milliseconds.

For fixed weights each row adds to the information of the states of its moment: a window is then tens of small blocks,
not tens of thousands of rows.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.events.plane_fit import ANY_ORDER
from velod.optimizer.batch_fit import Fit
from velod.optimizer.flow_equation import Rows, span
from velod.types import F64, I64

BIN_NS = 5_000_000
"""Flows this close in time share one gyroscope noise."""


class Bins:
    """Information x^T L x / 2 - eta^T x on x = [e, b_w, common], by bins of BIN_NS of time.

    ``count`` bins from number ``first`` on: bin k is [k BIN_NS, (k + 1) BIN_NS).
    """

    def __init__(self, first: int, count: int) -> None:
        self.first, self.count = first, count
        self.L = np.zeros((count, 9, 9))
        self.eta = np.zeros((count, 9))
        self.total = np.zeros((count, 2))  # weight, and weighted time since the start of the bin, ns

    @property
    def t_ns(self) -> list[int]:
        """Mean time of what is in each bin; the start of an empty one."""
        return [(self.first + k) * BIN_NS + int(wt / max(w, 1e-300)) for k, (w, wt) in enumerate(self.total)]

    def add(self, other: Bins, stop: int, slope: F64) -> None:
        """Add the bins of ``other`` that are among these and below number ``stop``.

        Each speaks of e at its mean time; ``slope`` (3,), m/s^2, of e takes both to that of the sum.
        """
        _merge(
            self.first, self.L, self.eta, self.total, other.first, other.L, other.eta, other.total, stop, slope
        )  # fmt: skip


def compress(rows: Rows, c: F64, fit: Fit, shared_error: float, slope: F64) -> Bins:
    """The rows, with those of ``common`` ``c`` (m, 3), as information in bins.

    ``shared_error`` divides the information of the flows, for errors that they share within a batch. ``slope`` (3,),
    m/s^2, of e takes each row to the mean time of its bin.
    """
    start_ns, end_ns = span(rows.t_ns)
    first = start_ns // BIN_NS
    bins = Bins(first, end_ns // BIN_NS - first + 1)
    _compress(
        rows.t_ns, rows.z, rows.a, rows.b, c, rows.sigma, fit.weight, fit.scale**2 * shared_error,
        first, slope, bins.total, bins.L, bins.eta,
    )  # fmt: skip
    return bins


@njit(cache=True, nogil=True, error_model="numpy")
def _compress(
    t_ns: I64,
    z: F64,
    a: F64,
    b: F64,
    c: F64,
    sigma: F64,
    weight: F64,
    variance: float,
    first: int,
    slope: F64,
    total: F64,
    L: F64,
    eta: F64,
) -> None:
    by_bin, start = _by_bin(t_ns, weight, first, len(L))
    columns, w = np.empty((10, by_bin.size)), np.empty(by_bin.size)
    for at in range(len(L)):
        for m in range(start[at], start[at + 1]):
            k = by_bin[m]
            w[m] = weight[k] / (sigma[k] * sigma[k] * variance)
            total[at, 0] += w[m]
            total[at, 1] += w[m] * (t_ns[k] - (at + first) * BIN_NS)
        for m in range(start[at], start[at + 1]):
            k = by_bin[m]
            dt = (t_ns[k] - (at + first) * BIN_NS - total[at, 1] / total[at, 0]) * 1e-9
            for i in range(3):
                columns[i, m], columns[3 + i, m], columns[6 + i, m] = a[k, i], -b[k, i], c[k, i]
            columns[9, m] = z[k] - dt * (a[k, 0] * slope[0] + a[k, 1] * slope[1] + a[k, 2] * slope[2])
        _add_normal_equations(columns, w, start[at], start[at + 1], L[at], eta[at])


@njit(cache=True, nogil=True)
def _by_bin(t_ns: I64, weight: F64, first: int, bins: int) -> tuple[I64, I64]:
    """The rows with a weight, bin after bin, and where each bin starts among them, (bins + 1,)."""
    start = np.zeros(bins + 1, np.int64)
    for k in range(t_ns.size):
        if weight[k] > 0.0:
            start[t_ns[k] // BIN_NS - first + 1] += 1
    for at in range(bins):
        start[at + 1] += start[at]
    order, free = np.empty(start[bins], np.int64), start.copy()
    for k in range(t_ns.size):
        if weight[k] > 0.0:
            at = t_ns[k] // BIN_NS - first
            order[free[at]] = k
            free[at] += 1
    return order, start


@njit(cache=True, nogil=True, fastmath=ANY_ORDER)
def _add_normal_equations(columns: F64, w: F64, start: int, stop: int, L: F64, eta: F64) -> None:
    """L (9, 9) and eta (9,) of the rows ``start`` to ``stop`` of ``columns`` (10, m), z the last, and w (m,)."""
    weighted = np.empty(stop - start)
    for i in range(9):
        column, own_w = columns[i, start:stop], w[start:stop]
        for k in range(weighted.size):
            weighted[k] = own_w[k] * column[k]
        for j in range(i, 10):
            column, s = columns[j, start:stop], 0.0
            for k in range(weighted.size):
                s += weighted[k] * column[k]
            if j == 9:
                eta[i] += s
                continue
            L[i, j] += s
            if j > i:
                L[j, i] += s


@njit(cache=True, nogil=True)
def _merge(
    first: int,
    L: F64,
    eta: F64,
    total: F64,
    more_first: int,
    more_L: F64,
    more_eta: F64,
    more_total: F64,
    stop: int,
    slope: F64,
) -> None:
    """Add bins from number ``more_first`` on to those from ``first`` on, each taken to the mean time of the sum."""
    for number in range(max(first, more_first), min(stop, first + len(total), more_first + len(more_total))):
        k, m = number - first, number - more_first
        if not more_total[m, 0] > 0.0:
            continue
        w, more_w = total[k, 0], more_total[m, 0]
        t = (total[k, 1] + more_total[m, 1]) / (w + more_w)
        dt = (t - total[k, 1] / w) * 1e-9 if w > 0.0 else 0.0
        more_dt = (t - more_total[m, 1] / more_w) * 1e-9
        for i in range(9):
            shift = more_shift = 0.0
            for j in range(3):
                shift += L[k, i, j] * slope[j]
                more_shift += more_L[m, i, j] * slope[j]
            eta[k, i] += shift * dt + more_eta[m, i] + more_shift * more_dt
            for j in range(9):
                L[k, i, j] += more_L[m, i, j]
        total[k, 0] += more_w
        total[k, 1] += more_total[m, 1]
