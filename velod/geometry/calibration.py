"""Calibration of the rig: two cameras, their relative pose, and the pose and clock of the IMU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from velod.types import F64


class CalibrationError(ValueError):
    """A calibration that cannot be used; the text names the file, the field and the reason."""


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
        _refuse_unknown(tree, ("left", "right", "R_RL", "t_RL", "T_cam_imu", "time_offset_s", "frames"), source)
        return checked(
            Calibration(
                left=_camera(_get(tree, "left", source), f"{source}: left"),
                right=_camera(_get(tree, "right", source), f"{source}: right"),
                R_RL=_array(_get(tree, "R_RL", source), (3, 3), f"{source}: R_RL"),
                t_RL=_array(_get(tree, "t_RL", source), (3,), f"{source}: t_RL"),
                T_cam_imu=_array(tree.get("T_cam_imu", np.eye(4).tolist()), (4, 4), f"{source}: T_cam_imu"),
                time_offset_s=_number(tree.get("time_offset_s", 0.0), f"{source}: time_offset_s"),
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
    _check_rotation(calib.R_RL, f"{source}: R_RL")
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
    _check_rotation(calib.T_cam_imu[:3, :3], f"{source}: T_cam_imu")
    for name, T in calib.frames.items():
        _check_rotation(T[:3, :3], f"{source}: frames: {name}")
    if not abs(calib.time_offset_s) <= MAX_TIME_OFFSET_S:
        raise CalibrationError(
            f"{source}: time_offset_s: must be within {MAX_TIME_OFFSET_S:g} s of zero, got {calib.time_offset_s:g}"
        )
    return calib


def load_calibration(path: str | Path, imu_path: str | Path | None = None) -> Calibration:
    """Read a calibration: velod's own YAML, a Kalibr camchain, or a ROS pair ``left.yaml`` and ``right.yaml``.

    A ROS pair is named by its directory or by either file. ``imu_path`` is a Kalibr camchain-imucam file that gives
    T_cam_imu and the clock offset where the stereo camchain does not.

    Raises CalibrationError naming the file, the field and the reason.
    """
    path = Path(path)
    if path.is_dir():
        if not (path / "left.yaml").is_file():
            raise CalibrationError(f"{path}: a folder without the left.yaml of a ROS pair")
        path = path / "left.yaml"
    tree = _read_yaml(path)
    if imu_path is not None and "cam0" not in tree:
        raise CalibrationError(f"{path}: a second file goes with a Kalibr camchain (cam0, cam1) only")
    if "cam0" in tree:
        imu_source = path if imu_path is None else Path(imu_path)
        return _from_kalibr(tree, str(path), tree if imu_path is None else _read_yaml(imu_source), str(imu_source))
    if "camera_matrix" in tree:
        return _from_ros_pair(path, tree)
    if "left" in tree or "right" in tree:
        return Calibration.from_tree(tree, str(path))
    raise CalibrationError(
        f"{path}: not a stereo calibration: none of left/right (velod), cam0/cam1 (Kalibr), camera_matrix (ROS) in it"
    )


def save_calibration(path: str | Path, calib: Calibration) -> None:
    """Write velod's own YAML; ``load_calibration`` reads back the same numbers."""
    text = yaml.safe_dump(calib.to_tree(), sort_keys=False, default_flow_style=None)
    Path(path).write_text("# p_right = R_RL p_left + t_RL; p_left = T_cam_imu p_imu; SI units, pixels\n" + text)


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CalibrationError(f"{path}: no such file") from None
    except OSError as e:
        raise CalibrationError(f"{path}: cannot be read: {e.strerror}") from None
    except UnicodeDecodeError:
        raise CalibrationError(f"{path}: cannot be read: not text in UTF-8") from None
    except yaml.YAMLError as e:
        raise CalibrationError(f"{path}: not plain YAML: {' '.join(str(e).split())}") from None
    if not isinstance(tree, dict):
        raise CalibrationError(f"{path}: must hold named values, got {type(tree).__name__}")
    return tree


def _from_kalibr(tree: dict[str, Any], source: str, imu_tree: dict[str, Any], imu_source: str) -> Calibration:
    """Kalibr's camchain: cam1.T_cn_cnm1 takes cam0 to cam1, cam0.T_cam_imu the IMU to cam0."""
    T_RL = _array(
        _get(_get(tree, "cam1", source), "T_cn_cnm1", f"{source}: cam1"), (4, 4), f"{source}: cam1.T_cn_cnm1"
    )
    imu_cam0 = _get(imu_tree, "cam0", imu_source)
    if not isinstance(imu_cam0, dict) or "T_cam_imu" not in imu_cam0:
        raise CalibrationError(
            f"{imu_source}: cam0.T_cam_imu: missing; add it, or give the camchain-imucam file as well"
        )
    return checked(
        Calibration(
            left=_kalibr_camera(tree["cam0"], f"{source}: cam0"),
            right=_kalibr_camera(tree["cam1"], f"{source}: cam1"),
            R_RL=T_RL[:3, :3],
            t_RL=T_RL[:3, 3],
            T_cam_imu=_array(imu_cam0["T_cam_imu"], (4, 4), f"{imu_source}: cam0.T_cam_imu"),
            time_offset_s=_number(imu_cam0.get("timeshift_cam_imu", 0.0), f"{imu_source}: cam0.timeshift_cam_imu"),
        ),
        source,
    )


def _kalibr_camera(tree: Any, where: str) -> Camera:
    if (model := _get(tree, "camera_model", where)) != "pinhole":
        raise CalibrationError(f"{where}.camera_model: must be pinhole, got {model!r}")
    width, height = _array(_get(tree, "resolution", where), (2,), f"{where}.resolution")
    fx, fy, cx, cy = _array(_get(tree, "intrinsics", where), (4,), f"{where}.intrinsics")
    model, dist = _distortion(
        _get(tree, "distortion_model", where), _get(tree, "distortion_coeffs", where), f"{where}.distortion"
    )
    return Camera(int(width), int(height), float(fx), float(fy), float(cx), float(cy), model, dist)


def _from_ros_pair(path: Path, tree: dict[str, Any]) -> Calibration:
    """``left.yaml`` and ``right.yaml``: ROS camera_info with ESVO's T_right_left and T_b_c (body from camera)."""
    if path.stem not in ("left", "right"):
        raise CalibrationError(f"{path}: one camera only; a ROS pair is left.yaml and right.yaml in one directory")
    other = path.with_stem("right" if path.stem == "left" else "left")
    trees = {path.stem: tree}
    # The file that was asked for is judged first, so that an error names it.
    T_RL_here = _transform(tree, "T_right_left", str(path))
    trees[other.stem] = _read_yaml(other)
    T_RL = {path.stem: T_RL_here, other.stem: _transform(trees[other.stem], "T_right_left", str(other))}["left"]
    left_path = str(path.with_stem("left"))
    calib = checked(
        Calibration(
            left=_ros_camera(trees["left"], left_path),
            right=_ros_camera(trees["right"], str(path.with_stem("right"))),
            R_RL=T_RL[:3, :3],
            t_RL=T_RL[:3, 3],
            T_cam_imu=_inverse(_transform(trees["left"], "T_b_c", left_path)),
        ),
        left_path,
    )
    _check_ros_baseline(calib, trees["right"], str(path.with_stem("right")))
    return calib


def _ros_camera(tree: dict[str, Any], source: str) -> Camera:
    K = _ros_matrix(_get(tree, "camera_matrix", source), (3, 3), f"{source}: camera_matrix")
    D = _get(tree, "distortion_coefficients", source)
    model, dist = _distortion(
        _get(tree, "distortion_model", source), _get(D, "data", source), f"{source}: distortion"
    )
    return Camera(
        width=_integer(_get(tree, "image_width", source), f"{source}: image_width"),
        height=_integer(_get(tree, "image_height", source), f"{source}: image_height"),
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        model=model,
        dist=dist,
    )


def _check_ros_baseline(calib: Calibration, right: dict[str, Any], source: str) -> None:
    """The right projection matrix, where there is one, repeats the baseline: P[0, 3] = -f b."""
    if "projection_matrix" not in right:
        return
    P = _ros_matrix(right["projection_matrix"], (3, 4), f"{source}: projection_matrix")
    if not P[0, 0] > 0.0:
        raise CalibrationError(f"{source}: projection_matrix: focal length must be positive, got {P[0, 0]:g}")
    b_P, b_T = -P[0, 3] / P[0, 0], float(np.linalg.norm(calib.t_RL))
    # 1 % of the baseline is 1 % of the velocity.
    if abs(b_P - b_T) > 0.01 * b_T:
        raise CalibrationError(
            f"{source}: T_right_left: baseline {b_T:.4g} m disagrees with the projection matrix's {b_P:.4g} m"
        )


def _frames(tree: Any, where: str) -> dict[str, F64]:
    if not isinstance(tree, dict):
        raise CalibrationError(f"{where}: must be a map from names to 4x4 matrices, got {tree!r}")
    return {str(name): _array(value, (4, 4), f"{where}: {name}") for name, value in tree.items()}


def _transform(tree: dict[str, Any], key: str, source: str) -> F64:
    """A 3x4 rigid transform as 4x4."""
    T = np.eye(4)
    T[:3] = _ros_matrix(_get(tree, key, source), (3, 4), f"{source}: {key}")
    _check_rotation(T[:3, :3], f"{source}: {key}")
    return T


def _inverse(T: F64) -> F64:
    """Of a rigid 4x4 transform."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def _ros_matrix(value: Any, shape: tuple[int, int], where: str) -> F64:
    """``{rows, cols, data}`` as ROS writes matrices. ``rows`` and ``cols`` default to ``shape``."""
    data = _get(value, "data", where)
    rows, cols = value.get("rows", shape[0]), value.get("cols", shape[1])
    if isinstance(data, list) and len(data) != shape[0] * shape[1]:
        raise CalibrationError(f"{where}: declared {rows}x{cols}, but data holds {len(data)} numbers")
    if (rows, cols) != shape:
        raise CalibrationError(f"{where}: must be {shape[0]}x{shape[1]}, declared {rows}x{cols}")
    return _array(data, (shape[0] * shape[1],), where).reshape(shape)


_MODEL = {"radtan": "radtan", "plumb_bob": "radtan", "equidistant": "equi", "equi": "equi", "none": "none"}


def _distortion(name: Any, coefficients: Any, where: str) -> tuple[str, tuple[float, ...]]:
    model = _MODEL.get(name) if isinstance(name, str) else None
    if model is None:
        raise CalibrationError(f"{where}: model must be one of {', '.join(_MODEL)}, got {name!r}")
    dist = tuple(_number(k, where) for k in coefficients) if isinstance(coefficients, list) else ()
    return (model, dist) if model != "none" else (model, ())


def _camera(tree: Any, where: str) -> Camera:
    _refuse_unknown(tree, ("width", "height", "fx", "fy", "cx", "cy", "model", "dist"), where)
    dist = tree.get("dist", ())
    if not isinstance(dist, list | tuple):
        raise CalibrationError(f"{where}.dist: must be a list of numbers, got {dist!r}")
    return Camera(
        width=_integer(_get(tree, "width", where), f"{where}.width"),
        height=_integer(_get(tree, "height", where), f"{where}.height"),
        fx=_number(_get(tree, "fx", where), f"{where}.fx"),
        fy=_number(_get(tree, "fy", where), f"{where}.fy"),
        cx=_number(_get(tree, "cx", where), f"{where}.cx"),
        cy=_number(_get(tree, "cy", where), f"{where}.cy"),
        model=tree.get("model", "none"),
        dist=tuple(_number(k, f"{where}.dist") for k in dist),
    )


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


def _check_rotation(R: F64, where: str) -> None:
    if R.shape != (3, 3) or not np.isfinite(R).all():
        raise CalibrationError(f"{where}: rotation must be 3x3 finite numbers")
    # Files round to 6 digits; ROS's rotations are orthonormal to 1e-5.
    if (error := float(np.abs(R @ R.T - np.eye(3)).max())) > 1e-3:
        raise CalibrationError(f"{where}: rotation is not orthonormal (off by {error:.2g})")
    if np.linalg.det(R) < 0.0:
        raise CalibrationError(f"{where}: rotation is a reflection (determinant -1)")


def _refuse_unknown(tree: Any, known: Sequence[str], where: str) -> None:
    if not isinstance(tree, dict):
        raise CalibrationError(f"{where}: must hold named values, got {tree!r}")
    for key in tree:
        if key not in known:
            raise CalibrationError(f"{where}: {key}: unknown; known: {', '.join(known)}")


def _get(tree: Any, key: str, where: str) -> Any:
    if not isinstance(tree, dict):
        raise CalibrationError(f"{where}: must hold named values, got {tree!r}")
    if key not in tree:
        raise CalibrationError(f"{where}: {key}: missing")
    return tree[key]


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise CalibrationError(f"{where}: must be a finite number, got {value!r}")
    return float(value)


def _integer(value: Any, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise CalibrationError(f"{where}: must be an integer, got {value!r}")
    return value


def _array(value: Any, shape: tuple[int, ...], where: str) -> F64:
    try:
        a = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise CalibrationError(f"{where}: must be {'x'.join(map(str, shape))} numbers") from None
    if a.shape != shape:
        got = "x".join(map(str, a.shape))
        raise CalibrationError(f"{where}: must be {'x'.join(map(str, shape))} numbers, got {got}")
    if not np.isfinite(a).all():
        raise CalibrationError(f"{where}: must be finite numbers")
    return a
