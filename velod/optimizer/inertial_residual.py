"""The IMU between two moments: the velocity carried on (Eq. 10) and the inertial residual of Eq. 14, linearised."""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.geometry.so3 import hat
from velod.optimizer.preintegration import Preintegration
from velod.optimizer.small import add_sandwich, invert3, multiply
from velod.types import F64

IMU_MODEL_SIGMA = 1e-3
"""What sampling leaves undetermined of one preintegration interval, m/s."""


def carry(p: Preintegration, v_B: F64, R_LB: F64, g_L: F64, cov: F64) -> tuple[F64, F64]:
    """v_B (3,) and its covariance (3, 3) at the end of ``p`` from [v_B, b_a, b_w, g_L] and cov (12, 12) before."""
    v, out = np.empty(3), np.empty((3, 3))
    _carry(
        p.R_gamma, p.beta, p.d_theta_d_bw, p.d_beta_d_ba, p.d_beta_d_bw, p.cov, p.dt, v_B, R_LB, g_L, cov, v, out
    )  # fmt: skip
    return v, out


def carried_jacobian(p: Preintegration, v_B: F64, R_LB: F64) -> F64:
    """d v_B / d [v_B, b_a, b_w, g_L] (3, 12) of ``carry``, at the velocity ``v_B`` (3,) after it."""
    R_T = p.R_gamma.T
    by_bias = R_T @ p.d_beta_d_bw + hat(v_B) @ p.d_theta_d_bw
    return np.hstack([R_T, R_T @ p.d_beta_d_ba, by_bias, -p.dt * (R_LB @ p.R_gamma).T])


def linearise(
    p: Preintegration, R_LB: F64, s_L: F64, on_error: bool, v_j: F64, blocks: F64, r: F64, information: F64
) -> None:
    """The residual blocks x - r, in the frame B_i: into blocks (3, 15), r (3,) and information (3, 3).

    x = [spline(t_i), b_a, b_w, g_L, spline(t_j)]; ``R_LB`` and ``s_L`` are at t_i and t_j (further ones are of no
    interest), ``on_error``: the spline is e of v_B = R_BL (s_L + e), else v_B; ``v_j`` is the velocity at t_j at
    which the residual is linearised.
    """
    _linearise(
        p.R_gamma, p.beta, p.d_theta_d_bw, p.d_beta_d_ba, p.d_beta_d_bw, p.cov, p.dt, p.b_a, p.b_w,
        R_LB, s_L, on_error, v_j, blocks, r, information,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def turn_by_noise(bin_s: F64, R_LB: F64, s_L: F64, e_L: F64, out: F64) -> None:
    """What the gyroscope's noise of each bin does to the residual, out (3, 3 bins), in the frame B_i.

    ``R_LB`` and ``s_L`` are those at t_i, t_j and in the middle of the bins, which last ``bin_s``; ``e_L`` at t_j.
    """
    v, turn, turned = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for k in range(bin_s.size):
        # a rate n for dt turns what follows, R_kj v_j - beta_kj: -R_ik [v_k]x dt n = -[v]x R_ik dt n, v in B_i
        multiply(R_LB[0].T, R_LB[2 + k], turn)
        for i in range(3):
            v[i] = 0.0
            for r in range(3):
                v[i] -= R_LB[0, r, i] * (s_L[2 + k, r] + e_L[r]) * bin_s[k]
        for i in range(3):
            turned[0, i] = v[1] * turn[2, i] - v[2] * turn[1, i]
            turned[1, i] = v[2] * turn[0, i] - v[0] * turn[2, i]
            turned[2, i] = v[0] * turn[1, i] - v[1] * turn[0, i]
        out[:, 3 * k : 3 * k + 3] = turned


@njit(cache=True, nogil=True)
def _multiply_hat(a: F64, v: F64, out: F64) -> None:
    """out = a [v]x."""
    for i in range(3):
        out[i, 0] = a[i, 1] * v[2] - a[i, 2] * v[1]
        out[i, 1] = a[i, 2] * v[0] - a[i, 0] * v[2]
        out[i, 2] = a[i, 0] * v[1] - a[i, 1] * v[0]


@njit(cache=True, nogil=True)
def _carry(
    R_gamma: F64,
    beta: F64,
    d_theta_d_bw: F64,
    d_beta_d_ba: F64,
    d_beta_d_bw: F64,
    cov_imu: F64,
    dt: float,
    v_i: F64,
    R_LB: F64,
    g_L: F64,
    cov: F64,
    v: F64,
    out: F64,
) -> None:
    J, N, R_T, hat_v, block = (
        np.empty((3, 12)),
        np.empty((3, 6)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
    )
    for i in range(3):
        v[i] = 0.0
        for k in range(3):
            R_T[i, k] = R_gamma[k, i]
            g_B = R_LB[0, k] * g_L[0] + R_LB[1, k] * g_L[1] + R_LB[2, k] * g_L[2]
            # Eq. 10 (with beta rotated by R_WB_i) in the frame B_j
            v[i] += R_T[i, k] * (beta[k] + v_i[k] - g_B * dt)
    _multiply_hat(np.eye(3), v, hat_v)
    J[:, :3] = R_T
    multiply(R_T, d_beta_d_ba, block)
    J[:, 3:6] = block
    multiply(R_T, d_beta_d_bw, block)
    J[:, 6:9] = block
    multiply(hat_v, d_theta_d_bw, block)
    J[:, 6:9] += block
    multiply(R_LB, R_gamma, block)
    J[:, 9:] = -dt * block.T
    N[:, :3], N[:, 3:] = hat_v, R_T
    out[:, :] = 0.0
    add_sandwich(J, cov, out)
    add_sandwich(N, cov_imu, out)


@njit(cache=True, nogil=True)
def _linearise(
    R_gamma: F64,
    beta: F64,
    d_theta_d_bw: F64,
    d_beta_d_ba: F64,
    d_beta_d_bw: F64,
    cov_imu: F64,
    dt: float,
    b_a: F64,
    b_w: F64,
    R_LB: F64,
    s_L: F64,
    on_error: bool,
    v_j: F64,
    blocks: F64,
    r: F64,
    information: F64,
) -> None:
    G, turned, block, cov = np.zeros((3, 6)), np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3))
    N_i, M_i, N_j, M_j = np.zeros(3), np.eye(3), np.zeros(3), np.eye(3)
    if on_error:
        _affine(R_LB[0], s_L[0], N_i, M_i)
        _affine(R_LB[1], s_L[1], N_j, M_j)
    _multiply_hat(R_gamma, v_j, turned)
    # Eq. 14: beta(b) - R(gamma(b)) v_j - g_B dt + v_i = 0
    blocks[:, :3] = M_i
    blocks[:, 3:6] = d_beta_d_ba
    multiply(turned, d_theta_d_bw, block)
    blocks[:, 6:9] = d_beta_d_bw + block
    blocks[:, 9:12] = -dt * R_LB[0].T
    multiply(R_gamma, M_j, block)
    blocks[:, 12:] = -block
    for i in range(3):
        r[i] = -beta[i] - N_i[i]
        for k in range(3):
            r[i] += blocks[i, 3 + k] * b_a[k] + blocks[i, 6 + k] * b_w[k] + R_gamma[i, k] * N_j[k]
        # the gyroscope's noise enters through R(gamma) v too, which Eq. 9 alone omits
        G[i, :3] = turned[i]
        G[i, 3 + i] = 1.0
        cov[i, i] = IMU_MODEL_SIGMA**2
    add_sandwich(G, cov_imu, cov)
    invert3(cov, information)


@njit(cache=True, nogil=True)
def _affine(R_LB: F64, s_L: F64, N: F64, M: F64) -> None:
    """v_B = N + M e, of v_B = R_BL (s_L + e)."""
    for i in range(3):
        N[i] = 0.0
        for k in range(3):
            M[i, k] = R_LB[k, i]
            N[i] += R_LB[k, i] * s_L[k]
