"""The flow equation (Eq. 4) of a batch, its linear solution (Eq. 15), and its compression into small informations.

With depth in inverse form the equation is linear in the velocity:

    |x_n| - n^T B w = (n^T A / Z) v,

and, at a known angular velocity less its bias, z = a . e - b . b_w with z = |x_n| - b . w - a . s, where a and b are
rows in the frame of the estimated error e. Robust weights come from the batch's own fit, never from a prediction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from velod.events.columns import readonly
from velod.events.plane_fit import ANY_ORDER
from velod.geometry.camera import motion_field_row
from velod.geometry.so3 import Row
from velod.optimizer.small import median
from velod.types import F32, F64, I64, U16

BIN_NS = 5_000_000
"""Flows this close in time share one gyroscope noise (DESIGN 5, item 6)."""
RIDGE = 1e-8
"""Of the trace of normal equations, on their diagonal: too little for what any flow has seen to feel it."""
PREDICTED_SHARE = (0.3, 3.0)
"""Bounds on predicted over measured flow where a sigma is scaled by it."""
COMMON = ("flow scale", "delay", "depth scale")
"""What all flows of a moment have wrong in common: speeds too large by a share, stamps too late by so many seconds,
inverse depths too large by a share. They last: the window estimates them beside the velocity."""
SEEDS = 0x7FFFFFFF
"""Bits of a seed that count."""
CHUNK = 64
"""Rows after which a minimal sample that is worse than the best so far is given up."""
MODEL_SIGMA_PX_S = 2.0
"""Flow error that neither fit nor depth accounts for (DESIGN 5.5)."""


@dataclass(frozen=True, slots=True)
class Rows:
    """One row per flow: z = a . e - b . b_w, with sigma; ``t_ns`` increasing is not required."""

    t_ns: I64  # (m,)
    z: F64  # (m,) px/s
    a: F64  # (m, 3) px/m
    b: F64  # (m, 3) px
    sigma: F64  # (m,) px/s


@dataclass(frozen=True, slots=True)
class Measured:
    """What the sigma of a row follows from, (m,) each."""

    speed: F64  # normal flow, px/s
    sigma: F64  # of speed, px/s
    translational: F64  # speed less what rotation explains, px/s
    depth_share: F64  # sigma of the inverse depth as a share of it


@dataclass(frozen=True, slots=True)
class Fit:
    """A batch's own solution of Eq. 15, with the robust weight of every row."""

    e: F64  # (3,) m/s
    cov: F64  # (3, 3)
    weight: F64  # (m,) 0 .. 1
    scale: float  # robust standard deviation of z / sigma, at least 1
    inliers: float  # share of rows with a weight


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


def body_rows(
    xy: tuple[F32, F32],
    n: F32,
    inv_depth: F32,
    camera: tuple[float, float, float],
    R_CB: F64,
    p_BC_B: F64,
) -> tuple[F64, F64]:
    """n^T A / Z and n^T B of Eq. 4 as rows on v_B and w_B, both (m, 3), for the camera at ``p_BC_B`` in B.

    ``camera`` is (f, cx, cy) of the rectified image. v_C = R_CB (v_B + w_B x p_BC_B): the lever arm adds p x a to b.
    """
    f, cx, cy = camera
    a_B, b_B = np.empty((len(xy[0]), 3)), np.empty((len(xy[0]), 3))
    _rows_in_body(
        xy[0].astype(np.float64) - cx, xy[1].astype(np.float64) - cy, f, n.astype(np.float64),
        inv_depth.astype(np.float64), R_CB, p_BC_B, a_B, b_B,
    )  # fmt: skip
    return a_B, b_B


def sigmas(measured: Measured, residual: F64) -> F64:
    """Standard deviation of a row, px/s, (m,): fit, model, and the depth's share of the translational flow.

    They are those of the flow that a velocity predicts, the measured one less ``residual`` (m,): a weight that
    follows the measured speed would believe slow flows more than fast ones, and bias the velocity.
    """
    out = np.empty_like(residual)
    _sigmas(measured.speed, measured.sigma, measured.translational, measured.depth_share, residual, out)
    return out


def on_velocity(t_ns: I64, speed: F64, a_B: F64, b_B: F64, w_B: F64) -> Rows:
    """Rows on v_B and b_w from those of ``body_rows`` and the measured w_B (m, 3); sigma is left to be set."""
    m = len(t_ns)
    z = np.empty(m)
    _less_product(speed, b_B, w_B, z)
    return Rows(t_ns, z, a_B, b_B, np.empty(m))


def pairs(flow_index: U16, depth_index: U16) -> tuple[I64, I64]:
    """Positions in both of the values that two increasing columns share."""
    at_flow = np.empty(min(len(flow_index), len(depth_index)), np.int64)
    at_depth = np.empty_like(at_flow)
    n = match(readonly(flow_index, np.uint16), readonly(depth_index, np.uint16), at_flow, at_depth)
    return at_flow[:n], at_depth[:n]


def solve(rows: Rows, iterations: int, seed: int, ridge: float = 0.0) -> Fit | None:
    """RANSAC on minimal samples of three rows, then five rounds of redescending least squares (Eq. 15 / Z).

    Returns None where the rows do not determine a velocity; with a ``ridge`` (RIDGE), e is 0 where they do not.
    """
    e = np.zeros(3)
    if len(rows.z) < 3 or not _ransac(rows.a, rows.z, rows.sigma, iterations, seed & SEEDS, ridge, e):
        return None
    weight, cov, stats = np.zeros(len(rows.z)), np.zeros((3, 3)), np.zeros(2)
    if not _reweight(rows.a, rows.z, rows.sigma, ridge, weight, e, cov, stats):
        return None
    return Fit(e, cov, weight, float(stats[0]), float(stats[1]))


def solve_weighted(rows: Rows, measured: Measured, iterations: int, seed: int, ridge: float = 0.0) -> Fit | None:
    """``solve`` with the sigmas of ``measured``, then with those of the flow that the first solution predicts.

    The sigmas are set in ``rows``, in place.
    """
    m = len(rows.z)
    weight, e, cov, stats = np.zeros(m), np.zeros(3), np.zeros((3, 3)), np.zeros(2)
    if m < 3 or not _solve_weighted(
        rows.a, rows.z, measured.speed, measured.sigma, measured.translational, measured.depth_share,
        iterations, seed & SEEDS, ridge, rows.sigma, weight, e, cov, stats,
    ):  # fmt: skip
        return None
    return Fit(e, cov, weight, float(stats[0]), float(stats[1]))


def less_known(rows: Rows, c: F64, common: F64, slope: F64, e: F64, t_ns: int) -> Rows:
    """The rows on what differs from ``e`` (3,) at ``t_ns``, where ``common`` (3,) and the slope of e (3,) are known.

    ``c`` (m, 3) are the rows of common errors. The sigma is that of ``rows``, the same array.
    """
    z = np.empty_like(rows.z)
    _less_known(rows.t_ns, rows.z, rows.a, c, common, slope, e, t_ns, z)
    return Rows(rows.t_ns, z, rows.a, rows.b, rows.sigma)


def turn_sensitivity(rows: Rows, fit: Fit) -> F64:
    """d e / d n (3, 3) of a batch's own solution: what an error n of the angular velocity, rad/s, does to it."""
    weighted = np.empty((3, 3))
    _weighted_product(rows.a, rows.b, rows.sigma, fit.weight, weighted)
    d_e_d_n: F64 = fit.cov @ weighted / fit.scale**2
    return d_e_d_n


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


@njit(cache=True, nogil=True)
def span(t_ns: I64) -> tuple[int, int]:
    """The first and the last of some times (m,), m > 0, in any order."""
    first = last = t_ns[0]
    for t in t_ns:
        first, last = min(first, t), max(last, t)
    return first, last


@njit(cache=True, nogil=True)
def match(left: U16, right: U16, at_left: I64, at_right: I64) -> int:
    """``pairs`` into at_left and at_right; returns how many."""
    i = j = n = 0
    while i < left.size and j < right.size:
        if left[i] < right[j]:
            i += 1
        elif left[i] > right[j]:
            j += 1
        else:
            at_left[n], at_right[n] = i, j
            i, j, n = i + 1, j + 1, n + 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def row_in_body(u: float, v: float, f: float, nx: float, ny: float, rho: float, R_CB: F64, p: F64) -> tuple[Row, Row]:
    """n^T A rho R_CB and n^T B R_CB + p x a, at (u, v) px from the principal point (Eq. 4)."""
    (a0, a1, a2), (b0, b1, b2) = motion_field_row(u, v, f, nx, ny)
    a = _times(rho * a0, rho * a1, rho * a2, R_CB)
    b = _times(b0, b1, b2, R_CB)
    across = p[1] * a[2] - p[2] * a[1], p[2] * a[0] - p[0] * a[2], p[0] * a[1] - p[1] * a[0]
    return a, (b[0] + across[0], b[1] + across[1], b[2] + across[2])


@njit(cache=True, nogil=True, error_model="numpy")
def _times(x: float, y: float, z: float, R: F64) -> Row:
    """The row (x, y, z) R."""
    return (
        x * R[0, 0] + y * R[1, 0] + z * R[2, 0],
        x * R[0, 1] + y * R[1, 1] + z * R[2, 1],
        x * R[0, 2] + y * R[1, 2] + z * R[2, 2],
    )


@njit(cache=True, nogil=True)
def _rows_in_body(u: F64, v: F64, f: float, n: F64, inv_depth: F64, R_CB: F64, p: F64, a: F64, b: F64) -> None:
    for k in range(u.size):
        a_k, b_k = row_in_body(u[k], v[k], f, n[k, 0], n[k, 1], inv_depth[k], R_CB, p)
        a[k, 0], a[k, 1], a[k, 2] = a_k
        b[k, 0], b[k, 1], b[k, 2] = b_k


@njit(cache=True, nogil=True, error_model="numpy")
def _sigmas(speed: F64, sigma: F64, translational: F64, depth_share: F64, residual: F64, out: F64) -> None:
    low, high = PREDICTED_SHARE
    for k in range(speed.size):
        share = min(max((speed[k] - residual[k]) / speed[k], low), high)
        from_fit = sigma[k] * share
        from_depth = (translational[k] - residual[k]) * depth_share[k]
        out[k] = math.sqrt(from_fit * from_fit + MODEL_SIGMA_PX_S**2 + from_depth * from_depth)


@njit(cache=True, nogil=True)
def _less_known(t_ns: I64, z: F64, a: F64, c: F64, common: F64, slope: F64, e: F64, at_ns: int, out: F64) -> None:
    for k in range(z.size):
        dt = (t_ns[k] - at_ns) * 1e-9
        out[k] = z[k]
        for i in range(3):
            out[k] -= c[k, i] * common[i] + a[k, i] * (e[i] + dt * slope[i])


@njit(cache=True, nogil=True)
def _weighted_product(a: F64, b: F64, sigma: F64, weight: F64, out: F64) -> None:
    """out (3, 3) = a^T diag(weight / sigma^2) b."""
    out[:, :] = 0.0
    for k in range(sigma.size):
        w = weight[k] / (sigma[k] * sigma[k])
        for i in range(3):
            for j in range(3):
                out[i, j] += w * a[k, i] * b[k, j]


@njit(cache=True, nogil=True)
def _less_product(z: F64, a: F64, x: F64, out: F64) -> None:
    """out = z - a . x, row by row."""
    for k in range(z.size):
        out[k] = z[k] - (a[k, 0] * x[k, 0] + a[k, 1] * x[k, 1] + a[k, 2] * x[k, 2])


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
def _merge(first, L, eta, total, more_first, more_L, more_eta, more_total, stop, slope):  # type: ignore[no-untyped-def]
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


@njit(cache=True, nogil=True)
def _solve3(H, g, x):  # type: ignore[no-untyped-def]
    """x = H^-1 g for symmetric H (3, 3) by cofactors; False when near-singular."""
    c00 = H[1, 1] * H[2, 2] - H[1, 2] * H[2, 1]
    c01 = H[1, 2] * H[2, 0] - H[1, 0] * H[2, 2]
    c02 = H[1, 0] * H[2, 1] - H[1, 1] * H[2, 0]
    det = H[0, 0] * c00 + H[0, 1] * c01 + H[0, 2] * c02
    if not abs(det) > 1e-9 * abs(H[0, 0] * H[1, 1] * H[2, 2]):
        return False
    x[0] = (c00 * g[0] + c01 * g[1] + c02 * g[2]) / det
    x[1] = (
        c01 * g[0] + (H[0, 0] * H[2, 2] - H[0, 2] * H[2, 0]) * g[1] + (H[0, 2] * H[1, 0] - H[0, 0] * H[1, 2]) * g[2]
    ) / det
    x[2] = (
        c02 * g[0] + (H[0, 1] * H[2, 0] - H[0, 0] * H[2, 1]) * g[1] + (H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0]) * g[2]
    ) / det
    return True


@njit(cache=True, nogil=True)
def _regularise(H, ridge):  # type: ignore[no-untyped-def]
    """Add ``ridge`` times the trace to the diagonal: a direction that no row sees keeps the value zero."""
    added = ridge * (H[0, 0] + H[1, 1] + H[2, 2])
    for i in range(3):
        H[i, i] += added


@njit(cache=True, nogil=True)
def _scale(size: F64) -> float:
    """Robust standard deviation of residuals whose absolute values these are, at least 1; ``size`` is reordered."""
    small = 0
    for k in range(size.size):
        small += 1.4826 * size[k] <= 1.0
    return 1.0 if 2 * small > size.size else max(1.0, 1.4826 * median(size))


@njit(cache=True, nogil=True, error_model="numpy")
def _per_sigma(a: F64, z: F64, sigma: F64) -> F64:
    """Columns (4, m) of a and z over their sigmas: what loops go along must be contiguous."""
    out = np.empty((4, z.size))
    for k in range(z.size):
        w = 1.0 / sigma[k]
        out[0, k], out[1, k], out[2, k], out[3, k] = w * a[k, 0], w * a[k, 1], w * a[k, 2], w * z[k]
    return out


@njit(cache=True, nogil=True, fastmath=ANY_ORDER)
def _truncated_cost(columns: F64, x0: float, x1: float, x2: float, limit: float) -> float:
    """Sum of the squared residuals of ``_per_sigma`` at (x0, x1, x2), each 9 at most; above ``limit`` not of all."""
    cost = 0.0
    for start in range(0, columns.shape[1], CHUNK):
        a0, a1, a2, z = (
            columns[0, start : start + CHUNK],
            columns[1, start : start + CHUNK],
            columns[2, start : start + CHUNK],
            columns[3, start : start + CHUNK],
        )
        for k in range(z.size):
            r = z[k] - a0[k] * x0 - a1[k] * x1 - a2[k] * x2
            cost += min(r * r, 9.0)
        if cost >= limit:
            break
    return cost


@njit(cache=True, nogil=True)
def _ransac(a, z, sigma, iterations, seed, ridge, best):  # type: ignore[no-untyped-def]
    """Minimal samples of Eq. 15; the truncated squared residual decides (MSAC, 3 sigma). False: none was regular."""
    m = len(z)
    x, H, g, columns = np.empty(3), np.empty((3, 3)), np.empty(3), _per_sigma(a, z, sigma)
    best_cost = np.inf
    state = np.uint64(seed) * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
    for _ in range(iterations):
        H[:, :] = 0.0
        g[:] = 0.0
        for _draw in range(3):
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            k = int((state >> np.uint64(33)) % np.uint64(m))
            for i in range(3):
                g[i] += a[k, i] * z[k]
                for j in range(3):
                    H[i, j] += a[k, i] * a[k, j]
        _regularise(H, ridge)
        if not _solve3(H, g, x):
            continue
        cost = _truncated_cost(columns, x[0], x[1], x[2], best_cost)
        if cost < best_cost:
            best_cost = cost
            best[:] = x
    return best_cost < np.inf


@njit(cache=True, nogil=True, fastmath=ANY_ORDER)
def _weighted_sums(columns: F64, r: F64, cutoff: float, weight: F64, H: F64, g: F64) -> None:
    """Tukey's weights of residuals ``r`` over sigma, 0 from ``cutoff`` on, and the normal equations with them."""
    a0, a1, a2, z = columns[0], columns[1], columns[2], columns[3]
    g0 = g1 = g2 = h00 = h01 = h02 = h11 = h12 = h22 = 0.0
    for k in range(r.size):
        u = r[k] / cutoff
        inside = max(1.0 - u * u, 0.0)
        w = inside * inside
        weight[k] = w
        w0, w1, w2 = w * a0[k], w * a1[k], w * a2[k]
        g0 += w0 * z[k]
        g1 += w1 * z[k]
        g2 += w2 * z[k]
        h00 += w0 * a0[k]
        h01 += w0 * a1[k]
        h02 += w0 * a2[k]
        h11 += w1 * a1[k]
        h12 += w1 * a2[k]
        h22 += w2 * a2[k]
    g[0], g[1], g[2] = g0, g1, g2
    H[0, 0], H[0, 1], H[0, 2] = h00, h01, h02
    H[1, 0], H[1, 1], H[1, 2] = h01, h11, h12
    H[2, 0], H[2, 1], H[2, 2] = h02, h12, h22


@njit(cache=True, nogil=True)
def _reweight(a, z, sigma, ridge, weight, e, cov, stats):  # type: ignore[no-untyped-def]
    """Five rounds of Tukey's weights from ``e`` (3,) on, in place; False where the rows do not determine it."""
    m = len(z)
    H, g, r, size, columns = np.empty((3, 3)), np.empty(3), np.empty(m), np.empty(m), _per_sigma(a, z, sigma)
    a0, a1, a2, z0 = columns[0], columns[1], columns[2], columns[3]
    scale = 1.0
    for _ in range(5):
        e0, e1, e2 = e[0], e[1], e[2]
        for k in range(m):
            r[k] = z0[k] - a0[k] * e0 - a1[k] * e1 - a2[k] * e2
            size[k] = abs(r[k])
        scale = _scale(size)
        # Tukey's biweight, 95 % efficient
        _weighted_sums(columns, r, 4.685 * scale, weight, H, g)
        _regularise(H, ridge)
        if not _solve3(H, g, e):
            return False
    column, unit = np.empty(3), np.zeros(3)
    for i in range(3):
        unit[:] = 0.0
        unit[i] = scale * scale
        _solve3(H, unit, column)
        cov[:, i] = column
    inliers = 0
    for k in range(m):
        inliers += weight[k] > 0.0
    stats[0], stats[1] = scale, inliers / m
    return True


@njit(cache=True, nogil=True)
def _solve_weighted(  # type: ignore[no-untyped-def]
    a, z, speed, speed_sigma, translational, depth_share, iterations, seed, ridge, sigma, weight, e, cov, stats
):
    """``_ransac`` and ``_reweight``, and this again with the sigmas of the flow that the first solution predicts."""
    residual = np.zeros(z.size)
    _sigmas(speed, speed_sigma, translational, depth_share, residual, sigma)
    if not _ransac(a, z, sigma, iterations, seed, ridge, e):
        return False
    if not _reweight(a, z, sigma, ridge, weight, e, cov, stats):
        return False
    for k in range(z.size):
        residual[k] = z[k] - a[k, 0] * e[0] - a[k, 1] * e[1] - a[k, 2] * e[2]
    _sigmas(speed, speed_sigma, translational, depth_share, residual, sigma)
    return _reweight(a, z, sigma, ridge, weight, e, cov, stats)
