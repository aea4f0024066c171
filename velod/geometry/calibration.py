"""Calibration of the rig: two cameras, their relative pose, and the pose and clock of the IMU."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from velod.geometry.named_values import CalibrationError, array, get, integer, number, refuse_unknown
from velod.types import F64

__all__ = ["Calibration", "CalibrationError", "Camera", "check_rotation", "checked"]


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
    frames: dict[str, F64] = field(default_factory=dict)  # by name: T_imu_frame (4, 4), p_B = T p_frame, m

    def to_tree(self) -> dict[str, Any]:
        """Plain numbers, strings and lists; ``from_tree`` reads them back."""
        return {
            "left": asdict(self.left) | {"dist": list(self.left.dist)},
            "right": asdict(self.right) | {"dist": list(self.right.dist)},
            "R_RL": self.R_RL.tolist(),
            "t_RL": self.t_RL.tolist(),
            "T_cam_imu": self.T_cam_imu.tolist(),
            "time_offset_s": self.time_offset_s,
            "frames": {name: T.tolist() for name, T in self.frames.items()},
        }

    @staticmethod
    def from_tree(tree: dict[str, Any], source: str) -> Calibration:
        """The inverse of ``to_tree``. What is not of the cameras' poses and pinholes may be left out.

        Raises CalibrationError naming ``source``, the field and the reason.
        """
        refuse_unknown(tree, ("left", "right", "R_RL", "t_RL", "T_cam_imu", "time_offset_s", "frames"), source)
        return checked(
            Calibration(
                left=_camera(get(tree, "left", source), f"{source}: left"),
                right=_camera(get(tree, "right", source), f"{source}: right"),
                R_RL=array(get(tree, "R_RL", source), (3, 3), f"{source}: R_RL"),
                t_RL=array(get(tree, "t_RL", source), (3,), f"{source}: t_RL"),
                T_cam_imu=array(tree.get("T_cam_imu", np.eye(4).tolist()), (4, 4), f"{source}: T_cam_imu"),
                time_offset_s=number(tree.get("time_offset_s", 0.0), f"{source}: time_offset_s"),
                frames=_frames(tree.get("frames", {}), f"{source}: frames"),
            ),
            source,
        )


DIST_LENGTHS = {"none": (0,), "radtan": (4, 5), "equi": (4,)}
"""Numbers of distortion coefficients by model (radtan: k3 may be left out)."""
MAX_TIME_OFFSET_S = 1.0


def checked(calib: Calibration, source: str) -> Calibration:
    """The same calibration if it is usable. Raises CalibrationError naming ``source``, the field and the reason."""
    _check_camera(calib.left, f"{source}: left")
    _check_camera(calib.right, f"{source}: right")
    check_rotation(calib.R_RL, f"{source}: R_RL")
    t_RL = calib.t_RL
    if t_RL.shape != (3,) or not np.isfinite(t_RL).all():
        raise CalibrationError(f"{source}: t_RL: must be 3 finite numbers")
    if not t_RL[0] < 0.0:
        raise CalibrationError(
            f"{source}: t_RL: x must be negative (the right camera lies at +x of the left), got {t_RL[0]:g};"
            " are left and right swapped, or is the baseline zero?"
        )
    if -t_RL[0] < 0.7 * float(np.linalg.norm(t_RL)):
        raise CalibrationError(f"{source}: t_RL: the cameras must lie side by side along x, got {t_RL.tolist()}")
    if calib.T_cam_imu.shape != (4, 4) or not np.isfinite(calib.T_cam_imu).all():
        raise CalibrationError(f"{source}: T_cam_imu: must be 4x4 finite numbers")
    if not np.array_equal(calib.T_cam_imu[3], [0.0, 0.0, 0.0, 1.0]):
        raise CalibrationError(f"{source}: T_cam_imu: last row must be 0 0 0 1, got {calib.T_cam_imu[3].tolist()}")
    check_rotation(calib.T_cam_imu[:3, :3], f"{source}: T_cam_imu")
    for name, T in calib.frames.items():
        check_rotation(T[:3, :3], f"{source}: frames: {name}")
    if not abs(calib.time_offset_s) <= MAX_TIME_OFFSET_S:
        raise CalibrationError(
            f"{source}: time_offset_s: must be within {MAX_TIME_OFFSET_S:g} s of zero, got {calib.time_offset_s:g}"
        )
    return calib


def check_rotation(R: F64, where: str) -> None:
    """Raise CalibrationError where ``R`` is no rotation (3, 3)."""
    if R.shape != (3, 3) or not np.isfinite(R).all():
        raise CalibrationError(f"{where}: rotation must be 3x3 finite numbers")
    # Files round to 6 digits; ROS's rotations are orthonormal to 1e-5.
    if (error := float(np.abs(R @ R.T - np.eye(3)).max())) > 1e-3:
        raise CalibrationError(f"{where}: rotation is not orthonormal (off by {error:.2g})")
    if np.linalg.det(R) < 0.0:
        raise CalibrationError(f"{where}: rotation is a reflection (determinant -1)")


def _camera(tree: Any, where: str) -> Camera:
    refuse_unknown(tree, ("width", "height", "fx", "fy", "cx", "cy", "model", "dist"), where)
    dist = tree.get("dist", ())
    if not isinstance(dist, list | tuple):
        raise CalibrationError(f"{where}.dist: must be a list of numbers, got {dist!r}")
    return Camera(
        width=integer(get(tree, "width", where), f"{where}.width"),
        height=integer(get(tree, "height", where), f"{where}.height"),
        fx=number(get(tree, "fx", where), f"{where}.fx"),
        fy=number(get(tree, "fy", where), f"{where}.fy"),
        cx=number(get(tree, "cx", where), f"{where}.cx"),
        cy=number(get(tree, "cy", where), f"{where}.cy"),
        model=tree.get("model", "none"),
        dist=tuple(number(k, f"{where}.dist") for k in dist),
    )


def _frames(tree: Any, where: str) -> dict[str, F64]:
    if not isinstance(tree, dict):
        raise CalibrationError(f"{where}: must be a map from names to 4x4 matrices, got {tree!r}")
    return {str(name): array(value, (4, 4), f"{where}: {name}") for name, value in tree.items()}


def _check_camera(camera: Camera, where: str) -> None:
    for name, size in (("width", camera.width), ("height", camera.height)):
        if not 16 <= size <= 16384:
            raise CalibrationError(f"{where}.{name}: must be 16 to 16384 px, got {size}")
    for name, f in (("fx", camera.fx), ("fy", camera.fy)):
        if not 0.0 < f < 1e5:
            raise CalibrationError(f"{where}.{name}: focal length must be positive, px, got {f:g}")
    if not 0.5 < camera.fx / camera.fy < 2.0:
        raise CalibrationError(f"{where}.fy: pixels must be nearly square, got fx {camera.fx:g}, fy {camera.fy:g}")
    for name, c, size in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        if not 0.0 < c < size - 1:
            raise CalibrationError(f"{where}.{name}: principal point outside the image, got {c:g} of {size} px")
    if not isinstance(camera.model, str) or camera.model not in DIST_LENGTHS:
        raise CalibrationError(f"{where}.model: must be one of {', '.join(DIST_LENGTHS)}, got {camera.model!r}")
    lengths = DIST_LENGTHS[camera.model]
    if len(camera.dist) not in lengths:
        expected = " or ".join(map(str, lengths))
        raise CalibrationError(f"{where}.dist: {camera.model} takes {expected} numbers, got {len(camera.dist)}")
    if not np.isfinite(camera.dist).all():
        raise CalibrationError(f"{where}.dist: must be finite, got {camera.dist}")
