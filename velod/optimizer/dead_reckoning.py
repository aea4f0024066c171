"""Dead reckoning: one integration of the velocity, with the attitude that gyroscope and gravity give (Sec. V-D).

Frame O: where the reckoning began, z up; at that moment B is turned from O by the tilt alone, heading zero.
"""

from __future__ import annotations

import numpy as np

from velod.geometry.so3 import exp, hat, quaternion_from_matrix
from velod.types import F64, NS_PER_S, Odometry

UP_O = np.array([0.0, 0.0, 1.0])
NO_TILT = np.zeros((3, 3))


class DeadReckoning:
    """Position and attitude in O, with the covariance of position and heading."""

    def __init__(self, correlation_s: float, gyro_noise: float) -> None:
        """``correlation_s``: how long an error of the velocity lasts; ``gyro_noise``: density, rad/s/sqrt(Hz)."""
        self._correlation_s, self._gyro_noise = correlation_s, gyro_noise
        self._seq = 0
        self.stop()

    def stop(self) -> None:
        """The velocity is lost: the next one begins a new reckoning."""
        self._t_ns = -1

    def update(self, t_ns: int, v_B: F64, cov: F64, R_LB: F64, g_B: F64, tilt_cov: F64 = NO_TILT) -> Odometry:
        """Reckon up to ``t_ns``, later than the last one.

        ``v_B`` (3,) m/s with ``cov`` (3, 3); ``R_LB`` (3, 3): attitude in any frame that only the gyroscope carries;
        ``g_B`` (3,): gravity, as specific force, upwards; ``tilt_cov`` (3, 3): of its direction in B, rad^2.
        """
        if self._t_ns < 0:
            self._begin(t_ns, v_B, R_LB, g_B, tilt_cov)
        else:
            self._go_on(t_ns, v_B, cov, R_LB, g_B, tilt_cov)
        self._t_ns, self._R_LB = t_ns, R_LB
        self._v_O = self._R_OB @ v_B
        q_OB = quaternion_from_matrix(self._R_OB)
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
        # the gyroscope turns, gravity keeps upright
        self._R_OB = upright(self._R_OB @ self._R_LB.T @ R_LB, g_B)
        mean_v_O = 0.5 * (self._v_O + self._R_OB @ v_B)
        self._p_O += mean_v_O * dt
        self._distance_m += float(np.linalg.norm(mean_v_O)) * dt
        F = np.eye(4)
        F[:3, 3] = np.cross(UP_O, mean_v_O) * dt
        self._cov = F @ self._cov @ F.T
        # an error that lasts for tau adds up as a random walk of density 2 tau sigma^2
        # as does one of the tilt, which turns the velocity: v x (z x d up)
        turned = hat(mean_v_O) @ hat(UP_O) @ self._R_OB
        cov_v_O = self._R_OB @ cov @ self._R_OB.T + turned @ tilt_cov @ turned.T
        self._cov[:3, :3] += cov_v_O * (2.0 * self._correlation_s * dt)
        self._cov[3, 3] += self._gyro_noise**2 * dt


def upright(R_OB: F64, g_B: F64) -> F64:
    """``R_OB`` turned by the smallest rotation that puts ``g_B`` along z of O."""
    up = R_OB @ g_B / np.linalg.norm(g_B)
    axis = np.cross(up, UP_O)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        # upside down: any horizontal axis is as good
        return R_OB if up[2] > 0.0 else np.asarray(exp(np.array([np.pi, 0.0, 0.0])) @ R_OB)
    return np.asarray(exp(axis / sine * np.arctan2(sine, up[2])) @ R_OB)
