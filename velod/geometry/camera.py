"""The pinhole camera: Eq. 1 (motion field) and the lens distortion models with their Jacobians.

Normalised coordinates are (X/Z, Y/Z): dimensionless, undistorted unless a name says ``distorted``.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.geometry.calibration import Camera
from velod.geometry.so3 import Row
from velod.types import F64

# Newton's method on the distortion: converged when the distorted position is reproduced to this (normalised units).
_TOLERANCE = 1e-10
_MAX_ITERATIONS = 30
# Where the lens squeezes the radius by more than this the model is about to fold over, and means nothing.
_MIN_STRETCH = 0.05


def A_v(x: F64, y: F64, f: float) -> F64:
    """A of Eq. 1, (..., 2, 3), px: flow = A_v v / Z + B_w w. x, y (...): px from the principal point; f: px."""
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    out = np.zeros((*x.shape, 2, 3))
    out[..., 0, 0] = -f
    out[..., 0, 2] = x
    out[..., 1, 1] = -f
    out[..., 1, 2] = y
    return out


def B_w(x: F64, y: F64, f: float) -> F64:
    """B of Eq. 1, (..., 2, 3), px: the flow of a rotation, rad/s. x, y (...): px from the principal point; f: px."""
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    out = np.empty((*x.shape, 2, 3))
    out[..., 0, 0] = x * y / f
    out[..., 0, 1] = -(f + x * x / f)
    out[..., 0, 2] = y
    out[..., 1, 0] = f + y * y / f
    out[..., 1, 1] = -x * y / f
    out[..., 1, 2] = -x
    return out


def motion_field_rows(x: F64, y: F64, f: float, cx: float, cy: float, n: F64) -> tuple[F64, F64]:
    """n^T A_v and n^T B_w (m, 3) of Eq. 4 for points x, y (m,), rectified px, and unit vectors n (m, 2).

    The normal flow of a point at depth Z is (n^T A_v) v / Z + (n^T B_w) w, px/s.
    """
    nA = np.empty((x.shape[0], 3))
    nB = np.empty((x.shape[0], 3))
    _motion_field_rows(
        np.ascontiguousarray(x, dtype=np.float64),
        np.ascontiguousarray(y, dtype=np.float64),
        float(f),
        float(cx),
        float(cy),
        np.ascontiguousarray(n, dtype=np.float64),
        nA,
        nB,
    )
    return nA, nB


@njit(cache=True, nogil=True, error_model="numpy")
def motion_field_row(u: float, v: float, f: float, nx: float, ny: float) -> tuple[Row, Row]:
    """``motion_field_rows`` for kernels: one row of each, at (u, v) px from the principal point."""
    # Eq. 4: n^T A_v and n^T B_w of Eq. 1
    nA = -f * nx, -f * ny, nx * u + ny * v
    nB = nx * u * v / f + ny * (f + v * v / f), -nx * (f + u * u / f) - ny * u * v / f, nx * v - ny * u
    return nA, nB


@njit(cache=True, nogil=True)
def _motion_field_rows(x: F64, y: F64, f: float, cx: float, cy: float, n: F64, nA: F64, nB: F64) -> None:
    for i in range(x.shape[0]):
        a, b = motion_field_row(x[i] - cx, y[i] - cy, f, n[i, 0], n[i, 1])
        nA[i, 0], nA[i, 1], nA[i, 2] = a
        nB[i, 0], nB[i, 1], nB[i, 2] = b


def distort(p: F64, camera: Camera) -> tuple[F64, F64]:
    """Distorted normalised positions (m, 2) of p (m, 2), and their Jacobians d distorted / d p (m, 2, 2)."""
    if camera.model == "radtan":
        return _distort_radtan(p, camera.dist)
    if camera.model == "equi":
        return _distort_equi(p, camera.dist)
    return p.copy(), np.broadcast_to(np.eye(2), (p.shape[0], 2, 2)).copy()


def undistort(q: F64, camera: Camera) -> F64:
    """Normalised positions (m, 2) of distorted ones q (m, 2) by Newton's method; NaN where the model has no answer.

    There is none beyond the radius at which the model folds over, and where the iteration does not converge.
    """
    p = q.copy()
    for _ in range(_MAX_ITERATIONS):
        d, J = distort(p, camera)
        r = q - d
        with np.errstate(all="ignore"):
            det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
            step = np.stack(
                [J[:, 1, 1] * r[:, 0] - J[:, 0, 1] * r[:, 1], J[:, 0, 0] * r[:, 1] - J[:, 1, 0] * r[:, 0]], axis=1
            )
            step /= det[:, None]
            # A full step next to the fold overshoots it; half the radius at a time does not.
            limit = 0.5 * np.maximum(np.linalg.norm(p, axis=1), 0.1)
            step *= np.minimum(1.0, limit / np.maximum(np.linalg.norm(step, axis=1), 1e-300))[:, None]
        p += step
        if np.nanmax(np.abs(r), initial=0.0) < _TOLERANCE:
            break
    with np.errstate(invalid="ignore"):
        reproduced = np.abs(distort(p, camera)[0] - q).max(axis=1) < 1e3 * _TOLERANCE
        p[~(reproduced & (np.linalg.norm(p, axis=1) <= model_radius(camera)))] = np.nan
    return p


def model_radius(camera: Camera) -> float:
    """The normalised radius up to which the distortion is one-to-one, in every direction; at most that of 80 deg."""
    angles = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    radii = np.tan(np.deg2rad(np.arange(0.5, 80.1, 0.5)))
    directions = np.tile(np.column_stack([np.cos(angles), np.sin(angles)]), (radii.shape[0], 1))
    J = distort(directions * np.repeat(radii, 32)[:, None], camera)[1]
    radial = np.einsum("mi,mij,mj->m", directions, J, directions)
    folded = (radial < _MIN_STRETCH) | (np.linalg.det(J) < _MIN_STRETCH**2)
    first = np.flatnonzero(folded.reshape(-1, 32).any(axis=1))
    return float(radii[first[0] - 1] if first.size and first[0] > 0 else 0.0 if first.size else radii[-1])


def _distort_radtan(p: F64, dist: tuple[float, ...]) -> tuple[F64, F64]:
    """Radial-tangential (Brown-Conrady): k1 k2 p1 p2 [k3]."""
    k1, k2, p1, p2, k3 = (*dist, 0.0)[:5]
    x, y = p[:, 0], p[:, 1]
    with np.errstate(all="ignore"):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        d_radial = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)  # d radial / d r2
        q = np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=1,
        )
        J = np.empty((p.shape[0], 2, 2))
        J[:, 0, 0] = radial + 2.0 * x * x * d_radial + 2.0 * p1 * y + 6.0 * p2 * x
        J[:, 0, 1] = 2.0 * x * y * d_radial + 2.0 * p1 * x + 2.0 * p2 * y
        J[:, 1, 0] = J[:, 0, 1]
        J[:, 1, 1] = radial + 2.0 * y * y * d_radial + 6.0 * p1 * y + 2.0 * p2 * x
    return q, J


def _distort_equi(p: F64, dist: tuple[float, ...]) -> tuple[F64, F64]:
    """Equidistant (Kannala-Brandt): theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)."""
    k1, k2, k3, k4 = dist
    r = np.maximum(np.linalg.norm(p, axis=1), 1e-9)
    theta = np.arctan(r)
    t2 = theta * theta
    theta_d = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    d_theta_d = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    scale = theta_d / r
    # d scale / d r, with d theta / d r = 1 / (1 + r^2)
    d_scale = (d_theta_d / (1.0 + r * r) - scale) / r
    q = p * scale[:, None]
    J = scale[:, None, None] * np.eye(2) + (d_scale / r)[:, None, None] * (p[:, :, None] * p[:, None, :])
    return q, J


def normalised(px: F64, camera: Camera) -> F64:
    """Distorted normalised positions (m, 2) of sensor pixels (m, 2)."""
    return np.asarray((px - [camera.cx, camera.cy]) / [camera.fx, camera.fy])


def pixels(q: F64, camera: Camera) -> F64:
    """Sensor pixels (m, 2) of distorted normalised positions (m, 2)."""
    return np.asarray(q * [camera.fx, camera.fy] + [camera.cx, camera.cy])
