"""A batch's own solution for the velocity (Eq. 15), and the robust weight of each of its flows.

Robust weights come from the batch's own fit, never from a prediction, which would confirm itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from velod.events.plane_fit import ANY_ORDER
from velod.optimizer.flow_equation import Measured, Rows, fill_sigmas
from velod.optimizer.small import median
from velod.types import F64

RIDGE = 1e-8
"""Of the trace of normal equations, on their diagonal: too little for what any flow has seen to feel it."""
SEEDS = 0x7FFFFFFF
"""Bits of a seed that count."""
CHUNK = 64
"""Rows after which a minimal sample that is worse than the best so far is given up."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A batch's own solution of Eq. 15, with the robust weight of every row."""

    e: F64  # (3,) m/s
    cov: F64  # (3, 3)
    weight: F64  # (m,) 0 .. 1
    scale: float  # robust standard deviation of z / sigma, at least 1
    inliers: float  # share of rows with a weight


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


def turn_sensitivity(rows: Rows, fit: Fit) -> F64:
    """d e / d n (3, 3) of a batch's own solution: what an error n of the angular velocity, rad/s, does to it."""
    weighted = np.empty((3, 3))
    _weighted_product(rows.a, rows.b, rows.sigma, fit.weight, weighted)
    d_e_d_n: F64 = fit.cov @ weighted / fit.scale**2
    return d_e_d_n


@njit(cache=True, nogil=True)
def _solve_weighted(
    a: F64,
    z: F64,
    speed: F64,
    speed_sigma: F64,
    translational: F64,
    depth_share: F64,
    iterations: int,
    seed: int,
    ridge: float,
    sigma: F64,
    weight: F64,
    e: F64,
    cov: F64,
    stats: F64,
) -> bool:
    """``_ransac`` and ``_reweight``, and this again with the sigmas of the flow that the first solution predicts."""
    residual = np.zeros(z.size)
    fill_sigmas(speed, speed_sigma, translational, depth_share, residual, sigma)
    if not _ransac(a, z, sigma, iterations, seed, ridge, e):
        return False
    if not _reweight(a, z, sigma, ridge, weight, e, cov, stats):
        return False
    for k in range(z.size):
        residual[k] = z[k] - a[k, 0] * e[0] - a[k, 1] * e[1] - a[k, 2] * e[2]
    fill_sigmas(speed, speed_sigma, translational, depth_share, residual, sigma)
    return _reweight(a, z, sigma, ridge, weight, e, cov, stats)


@njit(cache=True, nogil=True)
def _ransac(a: F64, z: F64, sigma: F64, iterations: int, seed: int, ridge: float, best: F64) -> bool:
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


@njit(cache=True, nogil=True)
def _reweight(a: F64, z: F64, sigma: F64, ridge: float, weight: F64, e: F64, cov: F64, stats: F64) -> bool:
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
def _scale(size: F64) -> float:
    """Robust standard deviation of residuals whose absolute values these are, at least 1; ``size`` is reordered."""
    small = 0
    for k in range(size.size):
        small += 1.4826 * size[k] <= 1.0
    return 1.0 if 2 * small > size.size else max(1.0, 1.4826 * median(size))


@njit(cache=True, nogil=True)
def _regularise(H: F64, ridge: float) -> None:
    """Add ``ridge`` times the trace to the diagonal: a direction that no row sees keeps the value zero."""
    added = ridge * (H[0, 0] + H[1, 1] + H[2, 2])
    for i in range(3):
        H[i, i] += added


@njit(cache=True, nogil=True)
def _solve3(H: F64, g: F64, x: F64) -> bool:
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
def _weighted_product(a: F64, b: F64, sigma: F64, weight: F64, out: F64) -> None:
    """out (3, 3) = a^T diag(weight / sigma^2) b."""
    out[:, :] = 0.0
    for k in range(sigma.size):
        w = weight[k] / (sigma[k] * sigma[k])
        for i in range(3):
            for j in range(3):
                out[i, j] += w * a[k, i] * b[k, j]
