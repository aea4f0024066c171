"""The attitude that gravity shows: which way is up in B, with its covariance. The heading is unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from velod.geometry.so3 import hat
from velod.optimizer.preintegration import Preintegration
from velod.types import F64


@dataclass(frozen=True, slots=True)
class Attitude:
    """At one moment; L is the frame that the gyroscope alone carries."""

    R_LB: F64  # (3, 3)
    up_B: F64  # (3,) unit vector against gravity
    up_cov: F64  # (3, 3) of up_B, rad^2: rank 2, nothing along up_B

    def seen_from(self, R_FB: F64) -> Attitude:
        """The same of another frame F of the body, in the place of B."""
        return Attitude(self.R_LB @ R_FB.T, R_FB @ self.up_B, R_FB @ self.up_cov @ R_FB.T)


def carry(p: Preintegration, R_LB: F64, g_L: F64, cov: F64) -> Attitude:
    """The attitude at the end of ``p`` from R_LB, gravity g_L (upwards) and cov (6, 6) of [b_w, g_L] before."""
    R_LBj = R_LB @ p.R_gamma
    norm = float(np.linalg.norm(g_L))
    up_B = R_LBj.T @ g_L / norm
    J = up_jacobian(p, R_LBj, up_B, norm)
    turned = hat(up_B)
    return Attitude(R_LBj, up_B, J @ cov @ J.T + turned @ p.cov[:3, :3] @ turned.T)


def up_jacobian(p: Preintegration, R_LBj: F64, up_B: F64, norm: float) -> F64:
    """d up_B / d [b_w, g_L], (3, 6), at the end of ``p``; ``norm`` is that of g_L, m/s^2."""
    # up_B = Exp(-dtheta) R_BL g_L / |g_L|: an error dtheta of gamma adds up_B x dtheta
    across = np.eye(3) - np.outer(up_B, up_B)
    return np.hstack([hat(up_B) @ p.d_theta_d_bw, across @ R_LBj.T / norm])
