"""Calibration of the rig: two cameras, their relative pose, and the pose and clock of the IMU."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from velod.types import F64


class CalibrationError(ValueError):
    """A calibration that is missing, incomplete or inconsistent; the text names the file, the field and the reason."""


@dataclass(frozen=True, slots=True)
class Camera:
    """Pinhole camera with lens distortion, on its own sensor's pixel grid."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "none"  # "none" | "radtan" (k1 k2 p1 p2 k3) | "equi" (k1 k2 k3 k4)
    dist: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Calibration:
    """The rig. p_right = R_RL p_left + t_RL; p_left = T_cam_imu p_B; t_imu = t_cam + time_offset_s (Kalibr)."""

    left: Camera
    right: Camera
    R_RL: F64  # (3, 3)
    t_RL: F64  # (3,), m; (-baseline, 0, 0) for a rectified pair
    T_cam_imu: F64 = field(default_factory=lambda: np.eye(4))  # (4, 4)
    time_offset_s: float = 0.0

    def to_tree(self) -> dict[str, Any]:
        """Plain numbers, strings and lists; ``from_tree`` reads them back."""
        raise NotImplementedError

    @staticmethod
    def from_tree(tree: dict[str, Any], source: str) -> Calibration:
        """Raises CalibrationError naming ``source``, the field and the reason."""
        raise NotImplementedError
