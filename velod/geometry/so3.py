"""Rotations: hat, exp, log, right Jacobian and quaternions (xyzw). Vectorised over leading axes.

Conventions after Forster et al. (2017), On-manifold preintegration: exp(w + dw) = exp(w) exp(J_r(w) dw).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from velod.types import F64

Row = tuple[float, float, float]

# Below this angle (rad) the closed forms give way to their series: both are then good to 1e-12 or better.
_SMALL = 1e-2


def hat(w: ArrayLike) -> F64:
    """Skew-symmetric matrices (..., 3, 3) of vectors (..., 3): hat(a) b = a x b."""
    w = np.asarray(w, dtype=np.float64)
    out = np.zeros((*w.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return out


def exp(w: ArrayLike) -> F64:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad (Rodrigues)."""
    w = np.asarray(w, dtype=np.float64)
    t2, theta, small = _angle(w)
    a = np.where(small, 1.0 + t2 * (-1.0 / 6.0 + t2 / 120.0), np.sin(theta) / theta)
    b = np.where(small, 0.5 + t2 * (-1.0 / 24.0 + t2 / 720.0), (1.0 - np.cos(theta)) / theta**2)
    W = hat(w)
    return np.asarray(np.eye(3) + a[..., None, None] * W + b[..., None, None] * (W @ W))


def log(R: ArrayLike) -> F64:
    """Rotation vectors (..., 3), rad, of length at most pi, of rotation matrices (..., 3, 3)."""
    q = quaternion_from_matrix(R)
    v = q[..., :3]
    norm = np.linalg.norm(v, axis=-1)
    small = norm < 1e-8
    safe = np.where(small, 1.0, norm)
    scale = np.where(small, 2.0, 2.0 * np.arctan2(safe, q[..., 3]) / safe)
    return np.asarray(scale[..., None] * v)


def right_jacobian(w: ArrayLike) -> F64:
    """J_r (..., 3, 3) of rotation vectors (..., 3): exp(w + dw) = exp(w) exp(J_r dw)."""
    w = np.asarray(w, dtype=np.float64)
    t2, theta, small = _angle(w)
    a = np.where(small, 0.5 + t2 * (-1.0 / 24.0 + t2 / 720.0), (1.0 - np.cos(theta)) / theta**2)
    b = np.where(small, 1.0 / 6.0 + t2 * (-1.0 / 120.0 + t2 / 5040.0), (theta - np.sin(theta)) / theta**3)
    W = hat(w)
    return np.asarray(np.eye(3) - a[..., None, None] * W + b[..., None, None] * (W @ W))


def right_jacobian_inverse(w: ArrayLike) -> F64:
    """J_r^-1 (..., 3, 3) of rotation vectors (..., 3) shorter than 2 pi."""
    w = np.asarray(w, dtype=np.float64)
    t2, theta, small = _angle(w)
    series = 1.0 / 12.0 + t2 * (1.0 / 720.0 + t2 / 30240.0)
    b = np.where(small, series, 1.0 / theta**2 - 0.5 / (theta * np.tan(0.5 * theta)))
    W = hat(w)
    return np.asarray(np.eye(3) + 0.5 * W + b[..., None, None] * (W @ W))


def _angle(w: F64) -> tuple[F64, F64, NDArray[np.bool_]]:
    """Squared lengths of w; lengths, with 1 in place of small ones (for closed forms); which are small."""
    t2 = np.sum(w * w, axis=-1)
    small = t2 < _SMALL**2
    return t2, np.sqrt(np.where(small, 1.0, t2)), small


def quaternion_from_matrix(R: ArrayLike) -> F64:
    """Unit quaternions (..., 4), xyzw, w >= 0, of rotation matrices (..., 3, 3)."""
    R = np.asarray(R, dtype=np.float64)
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    # Each candidate is the quaternion times 4 times one of its components: take the largest, never dividing by zero.
    t = np.stack([1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22, 1 + m00 + m11 + m22], axis=-1)
    xy, xz, yz = R[..., 1, 0] + R[..., 0, 1], R[..., 2, 0] + R[..., 0, 2], R[..., 2, 1] + R[..., 1, 2]
    wx, wy, wz = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    candidates = np.stack(
        [
            np.stack([t[..., 0], xy, xz, wx], axis=-1),
            np.stack([xy, t[..., 1], yz, wy], axis=-1),
            np.stack([xz, yz, t[..., 2], wz], axis=-1),
            np.stack([wx, wy, wz, t[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(t, axis=-1)[..., None, None]
    q = np.take_along_axis(candidates, best, axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0.0, -q, q))


def matrix_from_quaternion(q: ArrayLike) -> F64:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), xyzw, of any length but zero."""
    unit = np.asarray(q, dtype=np.float64)
    unit = unit / np.linalg.norm(unit, axis=-1, keepdims=True)
    v, w = unit[..., :3], unit[..., 3, None, None]
    V = hat(v)
    return np.asarray(np.eye(3) + 2.0 * w * V + 2.0 * (V @ V))


@njit(cache=True, nogil=True)
def exp_rows(x: float, y: float, z: float) -> tuple[Row, Row, Row]:
    """``exp`` for kernels: the rows of the rotation matrix of the rotation vector (x, y, z), rad."""
    theta2 = x * x + y * y + z * z
    # 0.1 rad, of which an IMU's samples are less apart; the series is good to 3e-14
    if theta2 < 0.01:
        a = 1.0 + theta2 * (-1.0 / 6.0 + theta2 * (1.0 / 120.0 - theta2 / 5040.0))
        b = 0.5 + theta2 * (-1.0 / 24.0 + theta2 * (1.0 / 720.0 - theta2 / 40320.0))
    else:
        theta = math.sqrt(theta2)
        a = math.sin(theta) / theta
        b = (1.0 - math.cos(theta)) / theta2
    return (
        (1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y),
        (b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x),
        (b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)),
    )


@njit(cache=True, nogil=True)
def exp_so3(w: F64, out: F64) -> None:
    """``exp_rows`` of w (3,) into out (3, 3)."""
    row0, row1, row2 = exp_rows(w[0], w[1], w[2])
    out[0, 0], out[0, 1], out[0, 2] = row0
    out[1, 0], out[1, 1], out[1, 2] = row1
    out[2, 0], out[2, 1], out[2, 2] = row2


@njit(cache=True, nogil=True)
def vee_so3(R: F64, out: F64) -> None:
    """The vector of R's skew part: its axis times the sine of its angle, into out (3,)."""
    out[0] = (R[2, 1] - R[1, 2]) / 2.0
    out[1] = (R[0, 2] - R[2, 0]) / 2.0
    out[2] = (R[1, 0] - R[0, 1]) / 2.0


@njit(cache=True, nogil=True)
def log_so3(R: F64, out: F64) -> None:
    """``log`` for kernels: the rotation vector, rad, of R (3, 3) by less than half a turn, into out (3,)."""
    vee_so3(R, out)
    sine = math.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    if sine > 1e-9:
        out *= math.atan2(sine, (R[0, 0] + R[1, 1] + R[2, 2] - 1.0) / 2.0) / sine


@njit(cache=True, nogil=True)
def quaternion_so3(R: F64, q: F64) -> None:
    """``quaternion_from_matrix`` for kernels: the unit quaternion, xyzw, w >= 0, of R (3, 3) into q (4,)."""
    best, largest = 0, -1.0
    for i in range(4):
        # 4 times the square of component i
        t = 1.0 + R[0, 0] + R[1, 1] + R[2, 2] if i == 3 else 1.0 + 2.0 * R[i, i] - R[0, 0] - R[1, 1] - R[2, 2]
        if t > largest:
            best, largest = i, t
    q[best] = largest
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        real = R[k, j] - R[j, k]
        if best == 3:
            q[i] = real
        elif best == i:
            q[j], q[k], q[3] = R[j, i] + R[i, j], R[k, i] + R[i, k], real
    scale = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[3] < 0.0:
        scale = -scale
    for i in range(4):
        q[i] *= scale
