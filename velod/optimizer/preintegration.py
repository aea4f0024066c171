"""IMU preintegration of Eq. 9 with its covariance and its Jacobians to the biases.

Between two samples gyroscope and accelerometer are linear in time; the rotation is integrated in two half steps and
beta by Simpson's rule. The covariance is that of white noise of the given densities (Forster et al., RSS 2015).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from velod.geometry.so3 import exp_so3
from velod.types import F64, I64


@dataclass(frozen=True, slots=True)
class Preintegration:
    """Over [t_i, t_j], in the frame B_i, for the biases ``b_a``, ``b_w``.

    ``R_gamma`` = R_{B_i B_j} and ``beta`` are those of Eq. 9; errors are R = R_gamma Exp(dtheta), beta + dbeta.
    """

    dt: float  # s
    R_gamma: F64  # (3, 3)
    beta: F64  # (3,) m/s
    d_theta_d_bw: F64  # (3, 3)
    d_beta_d_ba: F64  # (3, 3)
    d_beta_d_bw: F64  # (3, 3)
    cov: F64  # (6, 6) of [dtheta, dbeta]
    b_a: F64  # (3,)
    b_w: F64  # (3,)


def preintegrate(
    t_ns: I64,
    accel: F64,
    gyro: F64,
    t_i: int,
    t_j: int,
    b_a: F64,
    b_w: F64,
    accel_noise: float,
    gyro_noise: float,
) -> Preintegration:
    """Integrate samples (``t_ns`` increasing, covering [t_i, t_j]) from ``t_i`` to ``t_j``.

    ``accel_noise`` m/s^2/sqrt(Hz) and ``gyro_noise`` rad/s/sqrt(Hz) are continuous-time densities.
    Raises ValueError when the samples do not cover the interval.
    """
    if t_j < t_i or len(t_ns) == 0 or t_ns[0] > t_i or t_ns[-1] < t_j:
        raise ValueError(f"IMU samples do not cover [{t_i}, {t_j}] ns")
    R, beta, jt, ja, jw = np.eye(3), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    cov = np.zeros((6, 6))
    _integrate(t_ns, accel, gyro, t_i, t_j, b_a, b_w, accel_noise**2, gyro_noise**2, R, beta, jt, ja, jw, cov)
    return Preintegration((t_j - t_i) * 1e-9, R, beta, jt, ja, jw, cov, b_a.copy(), b_w.copy())


@njit(cache=True, nogil=True)
def _right_jacobian(phi, out):  # type: ignore[no-untyped-def]
    """J_r(phi) of SO(3) into out (3, 3): Exp(phi + d) = Exp(phi) Exp(J_r d)."""
    x, y, z = phi[0], phi[1], phi[2]
    th2 = x * x + y * y + z * z
    if th2 < 1e-8:
        a, b = 0.5 - th2 / 24.0, 1.0 / 6.0 - th2 / 120.0
    else:
        th = np.sqrt(th2)
        a, b = (1.0 - np.cos(th)) / th2, (th - np.sin(th)) / (th2 * th)
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[0, 1] = b * x * y + a * z
    out[0, 2] = b * x * z - a * y
    out[1, 0] = b * x * y - a * z
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[1, 2] = b * y * z + a * x
    out[2, 0] = b * x * z + a * y
    out[2, 1] = b * y * z - a * x
    out[2, 2] = 1.0 - b * (x * x + y * y)


@njit(cache=True, nogil=True)
def _mul(a, b, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(cache=True, nogil=True)
def _rotate_and_slope(R, jt, a, w, f, d_ba, d_bw):  # type: ignore[no-untyped-def]
    """Add to beta's step: f += w R a, and its derivatives d/db_a += -w R, d/db_w += -w R [a]x dtheta/db_w."""
    for i in range(3):
        f[i] += w * (R[i, 0] * a[0] + R[i, 1] * a[1] + R[i, 2] * a[2])
        # row i of R [a]x
        c0 = R[i, 1] * a[2] - R[i, 2] * a[1]
        c1 = R[i, 2] * a[0] - R[i, 0] * a[2]
        c2 = R[i, 0] * a[1] - R[i, 1] * a[0]
        for j in range(3):
            d_ba[i, j] -= w * R[i, j]
            d_bw[i, j] -= w * (c0 * jt[0, j] + c1 * jt[1, j] + c2 * jt[2, j])


@njit(cache=True, nogil=True)
def _half_step(R, jt, phi, h, E, J, tmp):  # type: ignore[no-untyped-def]
    """R <- R Exp(phi); dtheta/db_w <- Exp(phi)^T dtheta/db_w - J_r(phi) h."""
    exp_so3(phi, E)
    _right_jacobian(phi, J)
    _mul(R, E, tmp)
    for i in range(3):
        for j in range(3):
            R[i, j] = tmp[i, j]
    for i in range(3):
        for j in range(3):
            tmp[i, j] = E[0, i] * jt[0, j] + E[1, i] * jt[1, j] + E[2, i] * jt[2, j] - J[i, j] * h
    for i in range(3):
        for j in range(3):
            jt[i, j] = tmp[i, j]


@njit(cache=True, nogil=True)
def _grow_covariance(cov, R0, a, phi, dt, var_a, var_w, E, J, C, M, N):  # type: ignore[no-untyped-def]
    """One step of the covariance of [dtheta, dbeta]: cov <- F cov F^T + noise, F = [E^T 0; C 1], C = -R0 [a]x dt."""
    exp_so3(phi, E)
    _right_jacobian(phi, J)
    for i in range(3):
        C[i, 0] = -(R0[i, 1] * a[2] - R0[i, 2] * a[1]) * dt
        C[i, 1] = -(R0[i, 2] * a[0] - R0[i, 0] * a[2]) * dt
        C[i, 2] = -(R0[i, 0] * a[1] - R0[i, 1] * a[0]) * dt
    for i in range(3):
        for j in range(3):
            M[i, j] = C[i, 0] * cov[0, j] + C[i, 1] * cov[1, j] + C[i, 2] * cov[2, j]
            N[i, j] = C[i, 0] * cov[0, 3 + j] + C[i, 1] * cov[1, 3 + j] + C[i, 2] * cov[2, 3 + j]
    for i in range(3):
        for j in range(3):
            cov[3 + i, 3 + j] += N[i, j] + N[j, i] + M[i, 0] * C[j, 0] + M[i, 1] * C[j, 1] + M[i, 2] * C[j, 2]
        cov[3 + i, 3 + i] += var_a * dt
    for i in range(3):
        for j in range(3):
            N[i, j] = cov[i, 3 + j] + M[j, i]
    for i in range(3):
        for j in range(3):
            cov[i, 3 + j] = E[0, i] * N[0, j] + E[1, i] * N[1, j] + E[2, i] * N[2, j]
            cov[3 + j, i] = cov[i, 3 + j]
            M[i, j] = E[0, i] * cov[0, j] + E[1, i] * cov[1, j] + E[2, i] * cov[2, j]
    for i in range(3):
        for j in range(3):
            noise = (J[i, 0] * J[j, 0] + J[i, 1] * J[j, 1] + J[i, 2] * J[j, 2]) * var_w * dt
            cov[i, j] = M[i, 0] * E[0, j] + M[i, 1] * E[1, j] + M[i, 2] * E[2, j] + noise


@njit(cache=True, nogil=True)
def _lerp(t_ns, values, k, t, bias, out):  # type: ignore[no-untyped-def]
    """Sample linear between k and k + 1 at time t, less the bias."""
    s = (t - t_ns[k]) / (t_ns[k + 1] - t_ns[k])
    for i in range(3):
        out[i] = values[k, i] + s * (values[k + 1, i] - values[k, i]) - bias[i]


@njit(cache=True, nogil=True)
def _integrate(t_ns, accel, gyro, t_i, t_j, b_a, b_w, var_a, var_w, R, beta, jt, ja, jw, cov):  # type: ignore[no-untyped-def]
    a0, a1, am = np.empty(3), np.empty(3), np.empty(3)
    w0, w1 = np.empty(3), np.empty(3)
    phi = np.empty(3)
    E, J, tmp, R0 = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    C, M, N = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    k = np.searchsorted(t_ns, t_i, side="right") - 1
    k = min(max(k, 0), len(t_ns) - 2)
    t = t_i
    while t < t_j and k + 1 < len(t_ns):
        end = min(t_ns[k + 1], t_j)
        dt = (end - t) * 1e-9
        if dt > 0.0:
            _lerp(t_ns, accel, k, t, b_a, a0)
            _lerp(t_ns, accel, k, end, b_a, a1)
            _lerp(t_ns, gyro, k, t, b_w, w0)
            _lerp(t_ns, gyro, k, end, b_w, w1)
            for i in range(3):
                am[i] = 0.5 * (a0[i] + a1[i])
                phi[i] = 0.5 * (w0[i] + w1[i]) * dt
            R0[:, :] = R
            _grow_covariance(cov, R0, am, phi, dt, var_a, var_w, E, J, C, M, N)
            # Eq. 9: gamma by two half steps, beta by Simpson's rule over them
            _rotate_and_slope(R, jt, a0, dt / 6.0, beta, ja, jw)
            for i in range(3):
                phi[i] = (0.75 * w0[i] + 0.25 * w1[i]) * (0.5 * dt)
            _half_step(R, jt, phi, 0.5 * dt, E, J, tmp)
            _rotate_and_slope(R, jt, am, dt * (4.0 / 6.0), beta, ja, jw)
            for i in range(3):
                phi[i] = (0.25 * w0[i] + 0.75 * w1[i]) * (0.5 * dt)
            _half_step(R, jt, phi, 0.5 * dt, E, J, tmp)
            _rotate_and_slope(R, jt, a1, dt / 6.0, beta, ja, jw)
        t = end
        k += 1
