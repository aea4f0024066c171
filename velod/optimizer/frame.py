"""The frame that the velocity is published for: the IMU's, the left camera's, or one that the calibration names.

The velocity of another point of the same body differs by w x r; the axes may be turned as well. The gyroscope's noise
and the uncertainty of its bias enter through r.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from velod.config import ConfigError
from velod.geometry.calibration import Calibration
from velod.geometry.so3 import hat
from velod.types import F64

IMU, CAMERA = "imu", "camera"


@dataclass(frozen=True, slots=True)
class Rate:
    """Angular velocity of B at one moment, less the bias, and what is uncertain about it."""

    w_B: F64  # (3,) rad/s
    noise_cov: F64  # (3, 3) of the sample, (rad/s)^2
    bias_cov: F64  # (3, 3) of b_w, (rad/s)^2
    v_bias_cov: F64  # (3, 3) covariance of v_B with b_w


@dataclass(frozen=True, slots=True)
class OutputFrame:
    """A frame F fixed to the body: p_B = R_FB^T p_F + p_BF_B."""

    name: str
    R_FB: F64  # (3, 3)
    p_BF_B: F64  # (3,) origin of F in B, m

    @property
    def is_imu(self) -> bool:
        """Whether F is B."""
        return self.name == IMU

    def velocity(self, v_B: F64, cov: F64, rate: Rate) -> tuple[F64, F64]:
        """Velocity of F's origin in F (3,) m/s, and its covariance (3, 3), from v_B with ``cov`` (3, 3)."""
        # v_F = R_FB (v_B + w x p) with w = w_measured - b_w - noise: d/db_w = [p]x
        lever = hat(self.p_BF_B)
        cross = rate.v_bias_cov @ lever.T
        moved = cov + cross + cross.T + lever @ (rate.bias_cov + rate.noise_cov) @ lever.T
        return self.R_FB @ (v_B + np.cross(rate.w_B, self.p_BF_B)), self.R_FB @ moved @ self.R_FB.T


def output_frame(name: str, calibration: Calibration) -> OutputFrame:
    """The frame of this name. Raises ConfigError where neither velod nor the calibration knows it."""
    if name == IMU:
        return OutputFrame(IMU, np.eye(3), np.zeros(3))
    if name == CAMERA:
        R_CB, t_CB = calibration.T_cam_imu[:3, :3], calibration.T_cam_imu[:3, 3]
        return OutputFrame(CAMERA, R_CB, -R_CB.T @ t_CB)
    if name not in calibration.frames:
        known = ", ".join((IMU, CAMERA, *calibration.frames))
        raise ConfigError(
            f"optimizer.frame: no frame {name!r}; known: {known}; others go into the calibration, frames"
        )
    T_imu_frame = calibration.frames[name]
    return OutputFrame(name, T_imu_frame[:3, :3].T, T_imu_frame[:3, 3])
