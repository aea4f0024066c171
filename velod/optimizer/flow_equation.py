"""The flow equation (Eq. 4) of a batch, its linear solution (Eq. 15), and its compression into small informations.

With depth in inverse form the equation is linear in the velocity:

    |x_n| - n^T B w = (n^T A / Z) v,

and, at a known angular velocity less its bias, z = a . e - b . b_w with z = |x_n| - b . w - a . s, where a and b are
rows in the frame of the estimated error e. Robust weights come from the batch's own fit, never from a prediction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from velod.geometry.camera import motion_field_rows
from velod.types import F32, F64, I64

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
class Fit:
    """A batch's own solution of Eq. 15, with the robust weight of every row."""

    e: F64  # (3,) m/s
    cov: F64  # (3, 3)
    weight: F64  # (m,) 0 .. 1
    scale: float  # robust standard deviation of z / sigma, at least 1
    inliers: float  # share of rows with a weight


@dataclass(frozen=True, slots=True)
class Information:
    """Of [e, b_w] at one moment: x^T L x / 2 - eta^T x."""

    t_ns: int
    L: F64  # (6, 6)
    eta: F64  # (6,)


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
    nA, nB = motion_field_rows(xy[0].astype(np.float64), xy[1].astype(np.float64), f, cx, cy, n.astype(np.float64))
    a_B = (nA * inv_depth.astype(np.float64)[:, None]) @ R_CB
    b_B = nB @ R_CB + np.cross(p_BC_B, a_B)
    return a_B, b_B


def sigmas(speed_sigma: F32, inv_depth: F32, inv_depth_sigma: F32, translational: F64) -> F64:
    """Standard deviation of a row, px/s, (m,): fit, model, and the depth's share of the translational flow."""
    from_depth = translational * inv_depth_sigma / inv_depth
    return np.sqrt(speed_sigma.astype(np.float64) ** 2 + MODEL_SIGMA_PX_S**2 + from_depth**2)


def solve(rows: Rows, iterations: int, seed: int) -> Fit | None:
    """RANSAC on minimal samples of three rows, then five rounds of redescending least squares (Eq. 15 / Z).

    Returns None where the rows do not determine a velocity.
    """
    m = len(rows.z)
    weight, e, cov, stats = np.zeros(m), np.zeros(3), np.zeros((3, 3)), np.zeros(2)
    if m < 3 or not _solve(rows.a, rows.z, rows.sigma, iterations, seed & 0x7FFFFFFF, weight, e, cov, stats):
        return None
    return Fit(e, cov, weight, float(stats[0]), float(stats[1]))


def compress(rows: Rows, fit: Fit, bin_ns: int, gyro_noise: float, shared_error: float) -> list[Information]:
    """The rows of each ``bin_ns`` as one Information, the gyroscope's noise of the moment marginalised out.

    That noise moves all flows of a moment together: a nuisance n_w of variance gyro_noise^2 / bin, which enters as
    b_w does. ``shared_error`` divides the information of the flows, for errors they share within a batch.
    """
    bins = rows.t_ns // bin_ns
    w = fit.weight / (rows.sigma * fit.scale) ** 2 / shared_error
    noise_information = np.eye(3) * (bin_ns * 1e-9) / gyro_noise**2
    out = []
    for k in np.unique(bins[w > 0]):
        at = np.flatnonzero((bins == k) & (w > 0))
        J = np.hstack([rows.a[at], -rows.b[at]])
        Jw = J * w[at, None]
        L, eta = Jw.T @ J, Jw.T @ rows.z[at]
        # nuisance n_w: its columns are those of b_w
        gain = np.linalg.solve(L[3:, 3:] + noise_information, np.hstack([L[3:, :], eta[3:, None]]))
        K = L[:, 3:]
        t = int(np.average(rows.t_ns[at] - k * bin_ns, weights=w[at])) + int(k) * bin_ns
        out.append(Information(t, L - K @ gain[:, :6], eta - K @ gain[:, 6]))
    return out


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
def _normal_equations(a, z, sigma, weight, H, g):  # type: ignore[no-untyped-def]
    H[:, :] = 0.0
    g[:] = 0.0
    for k in range(len(z)):
        w = weight[k] / (sigma[k] * sigma[k])
        if w > 0.0:
            for i in range(3):
                wi = w * a[k, i]
                g[i] += wi * z[k]
                for j in range(3):
                    H[i, j] += wi * a[k, j]


@njit(cache=True, nogil=True)
def _ransac(a, z, sigma, iterations, seed, best, H, g):  # type: ignore[no-untyped-def]
    """Minimal samples of Eq. 15; the truncated squared residual decides (MSAC, 3 sigma). False: none was regular."""
    m = len(z)
    x = np.empty(3)
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
        if not _solve3(H, g, x):
            continue
        cost = 0.0
        for k in range(m):
            r = (z[k] - a[k, 0] * x[0] - a[k, 1] * x[1] - a[k, 2] * x[2]) / sigma[k]
            cost += min(r * r, 9.0)
        if cost < best_cost:
            best_cost = cost
            best[:] = x
    return best_cost < np.inf


@njit(cache=True, nogil=True)
def _solve(a, z, sigma, iterations, seed, weight, e, cov, stats):  # type: ignore[no-untyped-def]
    m = len(z)
    H, g, r = np.empty((3, 3)), np.empty(3), np.empty(m)
    if not _ransac(a, z, sigma, iterations, seed, e, H, g):
        return False
    scale = 1.0
    for _ in range(5):
        for k in range(m):
            r[k] = (z[k] - a[k, 0] * e[0] - a[k, 1] * e[1] - a[k, 2] * e[2]) / sigma[k]
        scale = max(1.0, 1.4826 * np.median(np.abs(r)))
        for k in range(m):
            u = r[k] / (4.685 * scale)  # Tukey's biweight, 95 % efficient
            weight[k] = (1.0 - u * u) ** 2 if abs(u) < 1.0 else 0.0
        _normal_equations(a, z, sigma, weight, H, g)
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
