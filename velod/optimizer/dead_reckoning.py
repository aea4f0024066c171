"""Dead reckoning: one integration of the velocity, with the attitude that gyroscope and gravity give (Sec. V-D).

Frame O: where the reckoning began, z up; at that moment B is turned from O by the tilt alone, heading zero.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from velod.events.sae import NEVER
from velod.geometry.so3 import exp_so3, quaternion_so3
from velod.optimizer.small import add_sandwich, multiply
from velod.types import F64, NS_PER_S, Odometry

NO_TILT = np.zeros((3, 3))


class DeadReckoning:
    """Position and attitude in O, with the covariance of position and heading."""

    def __init__(self, correlation_s: float, gyro_noise: float) -> None:
        """``correlation_s``: how long an error of the velocity lasts; ``gyro_noise``: density, rad/s/sqrt(Hz)."""
        self._correlation_s, self.gyro_noise = correlation_s, gyro_noise
        self._seq = 0
        self.stop()

    def stop(self) -> None:
        """The velocity is lost: the next one begins a new reckoning."""
        self._t_ns = NEVER

    def update(self, t_ns: int, v_B: F64, cov: F64, R_LB: F64, g_B: F64, tilt_cov: F64 = NO_TILT) -> Odometry:
        """Reckon up to ``t_ns``, later than the last one.

        ``v_B`` (3,) m/s with ``cov`` (3, 3); ``R_LB`` (3, 3): attitude in any frame that only the gyroscope carries;
        ``g_B`` (3,): gravity, as specific force, upwards; ``tilt_cov`` (3, 3): of its direction in B, rad^2.
        """
        if self._t_ns == NEVER:
            self._begin(t_ns, v_B, R_LB, g_B, tilt_cov)
        else:
            self._go_on(t_ns, v_B, cov, R_LB, g_B, tilt_cov)
        self._t_ns, self._R_LB, self._v_O = t_ns, R_LB, self._R_OB @ v_B
        q_OB = np.empty(4)
        quaternion_so3(self._R_OB, q_OB)
        self._seq += 1
        cov_p = self._cov[:3, :3].copy()
        return Odometry(self._seq - 1, t_ns, self._origin_t_ns, self._p_O.copy(), q_OB, cov_p, self._distance_m)

    def _begin(self, t_ns: int, v_B: F64, R_LB: F64, g_B: F64, tilt_cov: F64) -> None:
        self._origin_t_ns = t_ns
        self._p_O, self._distance_m = np.zeros(3), 0.0
        self._R_OB = upright(np.eye(3), g_B)
        self._cov = np.zeros((4, 4))  # of position and heading
        # which heading is zero follows from up: turning up by d about the axis to z turns it by d tan(angle / 2)
        up_z = float(g_B[2] / np.linalg.norm(g_B))
        self._cov[3, 3] = 0.5 * float(np.trace(tilt_cov)) * (1.0 - up_z) / max(1.0 + up_z, 1e-3)

    def _go_on(self, t_ns: int, v_B: F64, cov: F64, R_LB: F64, g_B: F64, tilt_cov: F64) -> None:
        dt = (t_ns - self._t_ns) / NS_PER_S
        self._distance_m += _go_on(
            dt, v_B, cov, self._R_LB, R_LB, g_B, tilt_cov, 2.0 * self._correlation_s * dt, self.gyro_noise**2 * dt,
            self._v_O, self._R_OB, self._p_O, self._cov,
        )  # fmt: skip


def upright(R_OB: F64, g_B: F64) -> F64:
    """``R_OB`` turned by the smallest rotation that puts ``g_B`` along z of O."""
    out = np.array(R_OB, np.float64)
    _put_upright(out, g_B)
    return out


@njit(cache=True, nogil=True)
def _put_upright(R: F64, g_B: F64) -> None:
    """``upright``, in place."""
    up, phi, E, turned = np.empty(3), np.zeros(3), np.empty((3, 3)), np.empty((3, 3))
    norm = math.sqrt(g_B[0] ** 2 + g_B[1] ** 2 + g_B[2] ** 2)
    for i in range(3):
        up[i] = (R[i, 0] * g_B[0] + R[i, 1] * g_B[1] + R[i, 2] * g_B[2]) / norm
    # the axis is up x z
    sine = math.sqrt(up[0] ** 2 + up[1] ** 2)
    if sine >= 1e-12:
        angle = math.atan2(sine, up[2])
        phi[0], phi[1] = up[1] / sine * angle, -up[0] / sine * angle
    elif up[2] > 0.0:
        return
    else:
        # upside down: any horizontal axis is as good
        phi[0] = math.pi
    exp_so3(phi, E)
    multiply(E, R, turned)
    R[:] = turned


@njit(cache=True, nogil=True)
def _go_on(dt, v_B, cov, R_LB_before, R_LB, g_B, tilt_cov, lasting, heading, v_O_before, R_OB, p_O, cov_O):  # type: ignore[no-untyped-def]
    """One step of ``dt`` s: R_OB (3, 3), p_O (3,) and cov_O (4, 4) in place. Returns the way, m.

    ``lasting`` s and ``heading`` rad^2: what the covariances of velocity and heading are to be multiplied with, and
    to grow by.
    """
    turn, turned, mean, F = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.eye(4)
    # the gyroscope turns, gravity keeps upright
    multiply(R_LB_before.T, R_LB, turn)
    multiply(R_OB, turn, turned)
    R_OB[:] = turned
    _put_upright(R_OB, g_B)
    for i in range(3):
        mean[i] = 0.5 * (v_O_before[i] + R_OB[i, 0] * v_B[0] + R_OB[i, 1] * v_B[1] + R_OB[i, 2] * v_B[2])
        p_O[i] += mean[i] * dt
    # a heading that errs turns the way about z
    F[0, 3], F[1, 3] = -mean[1] * dt, mean[0] * dt
    before = cov_O.copy()
    cov_O[:] = 0.0
    add_sandwich(F, before, cov_O)
    # an error of the tilt turns the velocity: v x (z x d up)
    for j in range(3):
        turned[0, j], turned[1, j] = -mean[2] * R_OB[0, j], -mean[2] * R_OB[1, j]
        turned[2, j] = mean[0] * R_OB[0, j] + mean[1] * R_OB[1, j]
    cov_v_O = np.zeros((3, 3))
    add_sandwich(R_OB, cov, cov_v_O)
    add_sandwich(turned, tilt_cov, cov_v_O)
    # an error that lasts for tau adds up as a random walk of density 2 tau sigma^2
    for i in range(3):
        for j in range(3):
            cov_O[i, j] += cov_v_O[i, j] * lasting
    cov_O[3, 3] += heading
    return math.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2) * dt
