"""The text format of the Event-Camera Dataset: ``events.txt``, ``imu.txt``, ``calib.txt``, ``groundtruth.txt``.

Mueggler et al., "The Event-Camera Dataset and Simulator", IJRR 2017. The dataset is monocular; velod takes a second
directory for the right camera, and a stereo calibration, since calib.txt has no baseline.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from velod.geometry.calibration import Calibration, CalibrationError
from velod.geometry.calibration_files import load_calibration
from velod.io.hdf5 import pixels, polarities
from velod.io.model import EventColumns, Imu, Parts, RecordingError, Truth
from velod.types import F64, I64

BLOCK = 1 << 17
"""Lines read at a time."""

_MAX_T_S = 9e9
"""Nanoseconds in 64 bits hold 9.2e9 s; seconds since 1970 are 1.8e9."""


def read(path: Path, right: Path | None, calibration: Calibration | None) -> Parts:
    """Calibration, left and right events, IMU and truth. Raises RecordingError, CalibrationError.

    ``path`` holds the left camera, ``right`` the right one; or ``path`` has the subdirectories ``left`` and
    ``right``. The IMU, the truth and ``calibration.yaml`` (see ``load_calibration``) are looked for in ``path``, then
    beside the left camera's events.
    """
    left_dir = path if (path / "events.txt").is_file() else path / "left"
    right_dir = right if right is not None else path / "right"
    if not right_dir.is_dir():
        raise RecordingError(
            f"{path}: one camera only: velod needs two; name the directory of the right camera's events.txt"
        )
    places = (path, left_dir)
    calib_path = _find("calibration.yaml", places)
    if calibration is None and calib_path is None:
        raise CalibrationError(
            f"{path}: no stereo calibration: calib.txt has no baseline; name a file (--calibration FILE) or put it "
            "there as calibration.yaml"
        )
    calib = calibration if calibration is not None else load_calibration(calib_path or path)
    imu_path, truth_path = _find("imu.txt", places), _find("groundtruth.txt", places)
    if imu_path is None:
        raise RecordingError(f"{path}: no IMU (imu.txt is missing): velod needs one beside the stereo cameras")
    truth = None if truth_path is None else _read_truth(truth_path, calib.T_cam_imu)
    left_events, right_events = (TextEvents.open(place / "events.txt") for place in (left_dir, right_dir))
    return Parts(calib, left_events, right_events, _read_imu(imu_path), truth)


def _find(name: str, places: tuple[Path, ...]) -> Path | None:
    return next((place / name for place in places if (place / name).is_file()), None)


@dataclass(frozen=True, slots=True)
class TextEvents:
    """``events.txt``: one event a line, ``t x y p`` with t in s."""

    name: str
    n_events: int
    first_t_ns: int
    last_t_ns: int
    path: Path

    @staticmethod
    def open(path: Path) -> TextEvents:
        """Reads the file once, to count its lines."""
        if not path.is_file():
            raise RecordingError(f"{path}: no such file")
        n, first, last = 0, "", ""
        for line in _lines(path):
            first, last, n = first or line, line, n + 1
        first_t_ns, last_t_ns = _ns(_table([first, last], 4, path)[:, 0], path) if n else (0, 0)
        return TextEvents(str(path), n, int(first_t_ns), int(last_t_ns), path)

    def blocks(self) -> Iterator[EventColumns]:
        """Consecutive blocks in file order. Raises RecordingError."""
        rest = _lines(self.path)
        while lines := list(islice(rest, BLOCK)):
            table = _table(lines, 4, self.path)
            yield EventColumns(
                _ns(table[:, 0], self.path),
                pixels(table[:, 1], self.name),
                pixels(table[:, 2], self.name),
                polarities(table[:, 3].astype(np.int64)),
            )


def _lines(path: Path) -> Iterator[str]:
    """The lines that hold something: neither blank nor a comment. Raises RecordingError."""
    try:
        with path.open(encoding="utf-8") as file:
            for line in file:
                if not line.isspace() and not line.startswith("#"):
                    yield line
    except UnicodeDecodeError:
        raise RecordingError(f"{path}: not plain text in UTF-8") from None


def _table(lines: list[str], columns: int, path: Path) -> F64:
    try:
        table: F64 = np.loadtxt(lines, dtype=np.float64, ndmin=2)
    except ValueError as e:
        raise RecordingError(f"{path}: not numbers: {str(e).splitlines()[0]}") from None
    if table.shape[1] != columns:
        raise RecordingError(f"{path}: {table.shape[1]} numbers a line, expected {columns}")
    if not np.isfinite(table).all():
        raise RecordingError(f"{path}: not finite numbers: {lines[int(np.argmin(np.isfinite(table).all(axis=1)))]!r}")
    return table


def _ns(t_s: F64, path: Path) -> I64:
    """Seconds with microsecond digits -> ns; rounding to the digits written keeps equal times equal."""
    if (beyond := np.abs(t_s) > _MAX_T_S).any():
        raise RecordingError(f"{path}: a time of {t_s[int(np.argmax(beyond))]:g} s: are the times seconds?")
    t_ns: I64 = np.rint(t_s * 1e6).astype(np.int64) * 1000
    return t_ns


def _read_all(path: Path, columns: int) -> F64:
    lines = list(_lines(path))
    if not lines:
        raise RecordingError(f"{path}: is empty")
    table = _table(lines, columns, path)
    step = np.diff(table[:, 0])
    if len(step) and step.min() <= 0:
        raise RecordingError(f"{path}: times do not increase at line {int(np.argmax(step <= 0)) + 2}")
    return table


def _read_imu(path: Path) -> Imu:
    """``t ax ay az gx gy gz`` in s, m/s^2, rad/s."""
    table = _read_all(path, 7)
    return Imu(_ns(table[:, 0], path), table[:, 1:4].copy(), table[:, 4:7].copy())


def _read_truth(path: Path, T_cam_imu: F64) -> Truth:
    """``t px py pz qx qy qz qw`` of the left camera in W: differentiated between neighbours (central differences)."""
    table = _read_all(path, 8)
    if len(table) < 3:
        raise RecordingError(f"{path}: {len(table)} poses are too few to differentiate")
    t_s = table[:, 0]
    R_WC = Rotation.from_quat(table[:, 4:8])
    R_WB = R_WC * Rotation.from_matrix(T_cam_imu[:3, :3])
    p_WB = table[:, 1:4] + R_WC.apply(T_cam_imu[:3, 3])
    v_W = (p_WB[2:] - p_WB[:-2]) / (t_s[2:] - t_s[:-2])[:, None]
    omega_B = (R_WB[:-2].inv() * R_WB[2:]).as_rotvec() / (t_s[2:] - t_s[:-2])[:, None]
    inner = R_WB[1:-1]
    return Truth(_ns(t_s[1:-1], path), inner.inv().apply(v_W), omega_B, inner.as_quat(), p_WB[1:-1])
