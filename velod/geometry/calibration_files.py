"""Files with a rig's calibration: velod's own YAML, Kalibr's camchains, and the pairs that ROS and ESVO use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from velod.geometry.calibration import Calibration, CalibrationError, Camera, check_rotation, checked
from velod.geometry.named_values import array, get, integer, number
from velod.types import F64


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
    T_RL = array(get(get(tree, "cam1", source), "T_cn_cnm1", f"{source}: cam1"), (4, 4), f"{source}: cam1.T_cn_cnm1")
    imu_cam0 = get(imu_tree, "cam0", imu_source)
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
            T_cam_imu=array(imu_cam0["T_cam_imu"], (4, 4), f"{imu_source}: cam0.T_cam_imu"),
            time_offset_s=number(imu_cam0.get("timeshift_cam_imu", 0.0), f"{imu_source}: cam0.timeshift_cam_imu"),
        ),
        source,
    )


def _kalibr_camera(tree: Any, where: str) -> Camera:
    if (model := get(tree, "camera_model", where)) != "pinhole":
        raise CalibrationError(f"{where}.camera_model: must be pinhole, got {model!r}")
    width, height = array(get(tree, "resolution", where), (2,), f"{where}.resolution")
    fx, fy, cx, cy = array(get(tree, "intrinsics", where), (4,), f"{where}.intrinsics")
    model, dist = _distortion(
        get(tree, "distortion_model", where), get(tree, "distortion_coeffs", where), f"{where}.distortion"
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
    K = _ros_matrix(get(tree, "camera_matrix", source), (3, 3), f"{source}: camera_matrix")
    D = get(tree, "distortion_coefficients", source)
    model, dist = _distortion(get(tree, "distortion_model", source), get(D, "data", source), f"{source}: distortion")
    return Camera(
        width=integer(get(tree, "image_width", source), f"{source}: image_width"),
        height=integer(get(tree, "image_height", source), f"{source}: image_height"),
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


def _transform(tree: dict[str, Any], key: str, source: str) -> F64:
    """A 3x4 rigid transform as 4x4."""
    T = np.eye(4)
    T[:3] = _ros_matrix(get(tree, key, source), (3, 4), f"{source}: {key}")
    check_rotation(T[:3, :3], f"{source}: {key}")
    return T


def _inverse(T: F64) -> F64:
    """Of a rigid 4x4 transform."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def _ros_matrix(value: Any, shape: tuple[int, int], where: str) -> F64:
    """``{rows, cols, data}`` as ROS writes matrices. ``rows`` and ``cols`` default to ``shape``."""
    data = get(value, "data", where)
    rows, cols = value.get("rows", shape[0]), value.get("cols", shape[1])
    if isinstance(data, list) and len(data) != shape[0] * shape[1]:
        raise CalibrationError(f"{where}: declared {rows}x{cols}, but data holds {len(data)} numbers")
    if (rows, cols) != shape:
        raise CalibrationError(f"{where}: must be {shape[0]}x{shape[1]}, declared {rows}x{cols}")
    return array(data, (shape[0] * shape[1],), where).reshape(shape)


_MODEL = {"radtan": "radtan", "plumb_bob": "radtan", "equidistant": "equi", "equi": "equi", "none": "none"}


def _distortion(name: Any, coefficients: Any, where: str) -> tuple[str, tuple[float, ...]]:
    model = _MODEL.get(name) if isinstance(name, str) else None
    if model is None:
        raise CalibrationError(f"{where}: model must be one of {', '.join(_MODEL)}, got {name!r}")
    dist = tuple(number(k, where) for k in coefficients) if isinstance(coefficients, list) else ()
    return (model, dist) if model != "none" else (model, ())
