"""Rectification of the stereo pair: look-up tables between sensor pixels and a common rectified grid.

In the rectified frame C (left) and its right twin both cameras have the same focal length and principal point, no
distortion, and rows that match: Z = f b / disparity (Sec. III-C).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from threading import Lock
from typing import Any

import numpy as np

from velod.geometry.calibration import Calibration, Camera
from velod.geometry.camera import distort, model_radius, normalised, pixels, undistort
from velod.types import F32, F64

# How much larger than the sensor the rectified grid may become to hold what the lens squeezed together.
_MAX_GROWTH = 1.3


@dataclass(frozen=True, slots=True)
class RectifiedPair:
    """The rectified pair as a camera: all that those need who handle no pixels of the sensors."""

    width: int  # of the rectified grid, px
    height: int
    f: float  # px
    cx: float  # px
    cy: float
    baseline_m: float
    R_rect_left: F64  # (3, 3) p_C = R_rect_left p_left
    R_CB: F64  # (3, 3) p_C = R_CB (p_B - p_BC_B)
    p_BC_B: F64  # (3,) origin of C in frame B, m
    identity: bool  # both sensors are the rectified grid: nothing needs remapping


@dataclass(frozen=True, slots=True)
class Rectification(RectifiedPair):
    """With its tables, indexed [y, x]; entries are (x, y), NaN where there is no counterpart. Not to be written to.

    A gradient (covector) g [1/px] on the sensor becomes M @ g on the rectified image, M = J^-T, J = d rectified /
    d sensor.
    """

    left_xy: F32  # (h, w, 2) left sensor px -> rectified px
    right_xy: F32  # (h, w, 2) right sensor px -> rectified px
    left_covector: F32  # (h, w, 2, 2) M on the left sensor grid
    right_covector: F32  # (h, w, 2, 2) M on the right sensor grid
    remap_left: tuple[F32, F32]  # (height, width) each: rectified px -> left sensor px, x and y
    remap_right: tuple[F32, F32]  # (height, width) each: rectified px -> right sensor px


def rectified_pair(calib: Calibration) -> RectifiedPair:
    """For a checked calibration. An undistorted, aligned and equal pair keeps its camera matrix exactly."""
    R_rect_left, _, grid = _rectified_cameras(calib)
    R_cam_imu, t_cam_imu = calib.T_cam_imu[:3, :3], calib.T_cam_imu[:3, 3]
    return RectifiedPair(
        width=grid.width,
        height=grid.height,
        f=grid.fy,
        cx=grid.cx,
        cy=grid.cy,
        baseline_m=float(np.linalg.norm(calib.t_RL)),
        R_rect_left=R_rect_left,
        R_CB=R_rect_left @ R_cam_imu,
        p_BC_B=-R_cam_imu.T @ t_cam_imu,
        identity=_is_rectified(calib),
    )


def rectify(calib: Calibration) -> Rectification:
    """As ``rectified_pair``, with tables. Made once for each calibration: they take 0.25 s for 346x260 pixels."""
    key = (calib.left, calib.right, *(a.tobytes() for a in (calib.R_RL, calib.t_RL, calib.T_cam_imu)))
    with _lock:
        if key not in _made:
            _made.clear()  # a process has one rig at a time
            _made[key] = _with_tables(calib)
        return _made[key]


_made: dict[tuple[Any, ...], Rectification] = {}
_lock = Lock()


def _with_tables(calib: Calibration) -> Rectification:
    pair = rectified_pair(calib)
    R_rect_left, R_rect_right, grid = _rectified_cameras(calib)
    left_xy, left_covector = _forward_tables(calib.left, R_rect_left, grid)
    right_xy, right_covector = _forward_tables(calib.right, R_rect_right, grid)
    return Rectification(
        **{f.name: getattr(pair, f.name) for f in fields(pair)},
        left_xy=left_xy,
        right_xy=right_xy,
        left_covector=left_covector,
        right_covector=right_covector,
        remap_left=_backward_table(calib.left, R_rect_left, grid),
        remap_right=_backward_table(calib.right, R_rect_right, grid),
    )


def _rectified_cameras(calib: Calibration) -> tuple[F64, F64, Camera]:
    """Rotations of both cameras into the rectified frame, and the camera that both are there."""
    if _is_rectified(calib):
        left = calib.left
        return np.eye(3), np.eye(3), Camera(left.width, left.height, left.fy, left.fy, left.cx, left.cy)
    R_rect_left, R_rect_right = _rectifying_rotations(calib.R_RL, calib.t_RL)
    return R_rect_left, R_rect_right, _common_grid(calib, R_rect_left, R_rect_right)


def _is_rectified(calib: Calibration) -> bool:
    """Nothing to do: no distortion, square pixels, equal cameras, no rotation, a baseline along x."""
    undistorted = not any(calib.left.dist) and not any(calib.right.dist) and calib.left.model != "equi"
    equal = (calib.left.width, calib.left.height) == (calib.right.width, calib.right.height) and np.allclose(
        [calib.left.fx, calib.right.fx, calib.right.fy, calib.left.cx, calib.left.cy],
        [calib.left.fy, calib.left.fy, calib.left.fy, calib.right.cx, calib.right.cy],
        rtol=0.0,
        atol=1e-9,
    )
    aligned = np.allclose(calib.R_RL, np.eye(3), rtol=0.0, atol=1e-9) and np.allclose(calib.t_RL[1:], 0.0, atol=1e-9)
    return undistorted and equal and aligned


def _rectifying_rotations(R_RL: F64, t_RL: F64) -> tuple[F64, F64]:
    """Rotations of both cameras into the rectified frame: x along the baseline, z between the two optical axes."""
    baseline_L = -R_RL.T @ t_RL
    x = baseline_L / np.linalg.norm(baseline_L)
    z_left, z_right = np.array([0.0, 0.0, 1.0]), R_RL[2]
    y = np.cross(z_left + z_right, x)
    y /= np.linalg.norm(y)
    R_rect_left = np.stack([x, y, np.cross(x, y)])
    return R_rect_left, R_rect_left @ R_RL.T


def _common_grid(calib: Calibration, R_rect_left: F64, R_rect_right: F64) -> Camera:
    """The rectified camera: the sensors' focal length, and room for the middles of all their edges."""
    f = 0.5 * (calib.left.fy + calib.right.fy)
    low, high, centres = [], [], []
    for camera, R in ((calib.left, R_rect_left), (calib.right, R_rect_right)):
        w, h = camera.width - 1.0, camera.height - 1.0
        middles = np.array([[0.0, h / 2], [w, h / 2], [w / 2, 0.0], [w / 2, h], [w / 2, h / 2]])
        p = f * _rotate(undistort(normalised(middles, camera), camera), R)[0]
        # The field of view's centre, and its edges relative to it.
        centres.append(p[4])
        low.append(np.array([p[0, 0], p[2, 1]]) - p[4])
        high.append(np.array([p[1, 0], p[3, 1]]) - p[4])
    size = np.array([calib.left.width, calib.left.height], dtype=np.float64)
    # A lens that folds before the edge's middle says NaN there: then as much as is allowed.
    most = 0.5 * _MAX_GROWTH * size
    below, above = -np.min(low, axis=0), np.max(high, axis=0)
    below, above = np.where(np.isnan(below), most, below), np.where(np.isnan(above), most, above)
    span = np.clip(np.ceil(below + above), size - 1.0, np.floor(_MAX_GROWTH * size) - 1.0)
    middle = np.mean(centres, axis=0) + 0.5 * np.clip(above - below, -size / 4, size / 4)
    cx, cy = 0.5 * span - middle
    return Camera(int(span[0]) + 1, int(span[1]) + 1, f, f, float(cx), float(cy))


def _rotate(p: F64, R: F64) -> tuple[F64, F64]:
    """Normalised positions (m, 2) seen by the camera rotated by R, and d out / d p (m, 2, 2); NaN behind it."""
    ray = np.column_stack([p, np.ones(p.shape[0])]) @ R.T
    with np.errstate(invalid="ignore"):
        ray[ray[:, 2] < 0.05] = np.nan
    out = ray[:, :2] / ray[:, 2:]
    J = (R[:2, :2] - out[:, :, None] * R[2, :2]) / ray[:, 2, None, None]
    return out, J


def _pixel_grid(width: int, height: int) -> F64:
    """All pixel positions (h * w, 2), row-major."""
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _forward_tables(camera: Camera, R_rect: F64, grid: Camera) -> tuple[F32, F32]:
    """Sensor px -> rectified px (h, w, 2), and the covector map J^-T (h, w, 2, 2)."""
    p = undistort(normalised(_pixel_grid(camera.width, camera.height), camera), camera)
    rectified, J_rotate = _rotate(p, R_rect)
    J_distort = distort(p, camera)[1]
    # J = grid K * J_rotate * J_distort^-1 * K^-1, so J^-1 = K * J_distort * J_rotate^-1 * grid K^-1.
    K, K_grid_inverse = np.diag([camera.fx, camera.fy]), np.diag([1.0 / grid.fx, 1.0 / grid.fy])
    J_inverse = K @ J_distort @ _inverse_2x2(J_rotate) @ K_grid_inverse
    shape = (camera.height, camera.width)
    xy = pixels(rectified, grid).astype(np.float32).reshape(*shape, 2)
    covector = np.ascontiguousarray(np.swapaxes(J_inverse, 1, 2), dtype=np.float32).reshape(*shape, 2, 2)
    covector[np.isnan(xy).any(axis=-1)] = np.nan
    return xy, covector


def _backward_table(camera: Camera, R_rect: F64, grid: Camera) -> tuple[F32, F32]:
    """Rectified px -> sensor px: x and y (height, width); NaN where the lens model has no such pixel."""
    p = _rotate(normalised(_pixel_grid(grid.width, grid.height), grid), R_rect.T)[0]
    sensor = pixels(distort(p, camera)[0], camera)
    with np.errstate(invalid="ignore"):
        sensor[~(np.linalg.norm(p, axis=1) <= model_radius(camera))] = np.nan
    table = sensor.astype(np.float32).reshape(grid.height, grid.width, 2)
    return np.ascontiguousarray(table[..., 0]), np.ascontiguousarray(table[..., 1])


def _inverse_2x2(J: F64) -> F64:
    out = np.empty_like(J)
    out[:, 0, 0], out[:, 1, 1] = J[:, 1, 1], J[:, 0, 0]
    out[:, 0, 1], out[:, 1, 0] = -J[:, 0, 1], -J[:, 1, 0]
    return out / (J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0])[:, None, None]
