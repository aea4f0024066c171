"""DSEC's layout: ``events/{left,right}/events.h5`` and ``cam_to_cam.yaml``; and beside them an IMU.

Gehrig et al., "DSEC: A Stereo Event Camera Dataset for Driving Scenarios", RA-L 2021.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from velod.geometry.calibration import Calibration, CalibrationError, Camera, checked
from velod.io.hdf5 import Hdf5Events, opened, read_imu
from velod.io.model import Parts, RecordingError
from velod.types import F64


def read(path: Path, calibration: Calibration | None) -> Parts:
    """Calibration, left and right events, IMU; there is no truth. Raises RecordingError, CalibrationError.

    The IMU is read from ``imu.h5`` in the directory: ``/imu/{t_us, accel, gyro}`` on the cameras' clock, and the
    attribute ``T_cam_imu`` (4 x 4; left where it is missing: the camera's own axes).
    """
    left, right = (_open_events(path / "events" / side / "events.h5") for side in ("left", "right"))
    imu_path = path / "imu.h5"
    if not imu_path.is_file():
        raise RecordingError(
            f"{path}: no IMU: velod needs one, and DSEC keeps it apart (lidar_imu.zip): "
            "put it into imu.h5 as /imu/t_us, accel, gyro"
        )
    with opened(imu_path) as file:
        imu = read_imu(file, imu_path)
        T_cam_imu = np.asarray(file["imu"].attrs.get("T_cam_imu", np.eye(4)), dtype=np.float64)
    return Parts(calibration or read_calibration(_find_calibration(path), T_cam_imu), left, right, imu, None)


def _open_events(path: Path) -> Hdf5Events:
    with opened(path) as file:
        offset = file.get("t_offset")
        return Hdf5Events.open(file, path, "events", 0 if offset is None else int(offset[()]))


def _find_calibration(path: Path) -> Path:
    for candidate in (path / "cam_to_cam.yaml", path / "calibration" / "cam_to_cam.yaml"):
        if candidate.is_file():
            return candidate
    raise CalibrationError(
        f"{path}: no calibration: neither cam_to_cam.yaml nor calibration/cam_to_cam.yaml is there; "
        "name a file: --calibration FILE"
    )


def read_calibration(path: Path, T_cam_imu: F64) -> Calibration:
    """``cam_to_cam.yaml``: cam0 is the left, cam3 the right event camera; T_ba maps from camera a to camera b."""
    try:
        tree = yaml.safe_load(path.read_text())
        left, right = (_camera(tree["intrinsics"][name], name) for name in ("cam0", "cam3"))
        T_10, T_21, T_32 = (_transform(tree["extrinsics"][name], name) for name in ("T_10", "T_21", "T_32"))
        T_30 = T_32 @ T_21 @ T_10
    except KeyError as e:
        raise CalibrationError(f"{path}: {e.args[0]} is missing") from None
    except (yaml.YAMLError, TypeError, ValueError) as e:
        raise CalibrationError(f"{path}: not a DSEC calibration: {' '.join(str(e).split())}") from None
    return checked(Calibration(left, right, T_30[:3, :3], T_30[:3, 3], T_cam_imu), str(path))


def _camera(tree: dict[str, Any], name: str) -> Camera:
    if tree["distortion_model"] != "radtan":
        raise ValueError(f"{name}: distortion model {tree['distortion_model']!r}, expected radtan")
    fx, fy, cx, cy = _numbers(tree, "camera_matrix", 4, name)
    width, height = (int(v) for v in _numbers(tree, "resolution", 2, name))
    k1, k2, p1, p2 = _numbers(tree, "distortion_coeffs", 4, name)
    return Camera(width, height, fx, fy, cx, cy, "radtan", (k1, k2, p1, p2, 0.0))


def _numbers(tree: dict[str, Any], key: str, n: int, camera: str) -> list[float]:
    if key not in tree:
        raise ValueError(f"{camera}: {key} is missing")
    values = [float(v) for v in tree[key]]
    if len(values) != n:
        raise ValueError(f"{camera}: {key} holds {len(values)} numbers, expected {n}")
    return values


def _transform(value: Any, name: str) -> F64:
    T = np.array(value, dtype=np.float64)
    if T.shape != (4, 4):
        raise ValueError(f"{name}: must be 4x4 numbers")
    return T
