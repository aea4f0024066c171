"""velod's sequence files (HDF5): ``/events/{left,right}``, ``/imu``, ``/calib``; optionally ``/gt``, ``/depth``."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from velod.geometry.calibration import Calibration, CalibrationError, Camera, checked
from velod.io.hdf5 import Hdf5Events, dataset, increasing_ns, opened, read_imu, same_length
from velod.io.model import DepthTruth, EventColumns, Imu, Parts, RecordingError, SequenceData, Truth
from velod.types import F64, I64

_MODELS = {"radtan": 5, "equi": 4}
_EVENT_COLUMNS = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.uint8}
_CHUNK = 1 << 17
_IMU_CHUNK = 1 << 12
_SPARE_BYTES = 1 << 23
"""What HDF5 holds back until it closes. It cannot close on a full disk, so the disk must never be full."""
# Level 1 with byte shuffle: 3 bytes an event instead of 13, read as fast; higher levels take long for little.
_PACKED = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


def read(path: Path, calibration: Calibration | None) -> Parts:
    """Calibration, left and right events, IMU and truth. Raises RecordingError, CalibrationError."""
    with opened(path) as file:
        if "events" not in file:
            raise RecordingError(f"{path}: not a velod sequence: /events is missing")
        calib = calibration or read_calibration(file, path)
        left = Hdf5Events.open(file, path, "events/left")
        right = Hdf5Events.open(file, path, "events/right")
        imu = read_imu(file, path)
        truth = _read_truth(file, path) if "gt" in file else None
        for source, camera in ((left, calib.left), (right, calib.right)):
            _check_fits(file, source, camera, path)
    return Parts(calib, left, right, imu, truth)


def read_depth(path: str | Path) -> DepthTruth | None:
    """True depth images of the left camera, if the file has them. Raises RecordingError."""
    path = Path(path)
    with opened(path) as file:
        if "depth" not in file:
            return None
        t_ns = increasing_ns(dataset(file, "depth/t_us", path)[:], path, "depth/t_us")
        return DepthTruth(t_ns, np.asarray(file["depth/left"], dtype=np.float32))


def read_calibration(file: Any, path: Path) -> Calibration:
    """``/calib``: one pinhole model for both cameras, which look the same way, ``baseline_m`` apart along x."""
    if "calib" not in file:
        raise CalibrationError(f"{path}: no calibration (/calib is missing); name a file: --calibration FILE")
    attrs = file["calib"].attrs
    number = {name: _number(attrs, name, path) for name in ("width", "height", "fx", "fy", "cx", "cy", "baseline_m")}
    model, dist = _distortion(attrs, path)
    camera = Camera(
        int(number["width"]),
        int(number["height"]),
        number["fx"],
        number["fy"],
        number["cx"],
        number["cy"],
        model,
        dist,
    )
    T_cam_imu = np.asarray(attrs.get("T_cam_imu", np.eye(4)), dtype=np.float64)
    offset_s = _number(attrs, "time_offset_s", path) if "time_offset_s" in attrs else 0.0
    stated = Calibration(camera, camera, np.eye(3), np.array([-number["baseline_m"], 0.0, 0.0]), T_cam_imu, offset_s)
    return checked(stated, f"{path}:/calib")


def _number(attrs: Any, name: str, path: Path) -> float:
    if name not in attrs:
        raise CalibrationError(f"{path}: calibration is incomplete: attribute {name} of /calib is missing")
    value = attrs[name]
    if np.ndim(value) != 0 or np.asarray(value).dtype.kind not in "iuf":
        raise CalibrationError(f"{path}: attribute {name} of /calib must be a number, got {value!r}")
    return float(value)


def _distortion(attrs: Any, path: Path) -> tuple[str, tuple[float, ...]]:
    stated = [model for model in _MODELS if f"dist_{model}" in attrs]
    if len(stated) == 2:
        raise CalibrationError(f"{path}: /calib has both dist_radtan and dist_equi")
    if not stated:
        return "none", ()
    dist = np.atleast_1d(np.asarray(attrs[f"dist_{stated[0]}"], dtype=np.float64))
    if dist.shape != (_MODELS[stated[0]],):
        raise CalibrationError(
            f"{path}: dist_{stated[0]} of /calib must hold {_MODELS[stated[0]]} numbers, got {dist.size}"
        )
    return stated[0], tuple(float(d) for d in dist)


def _check_fits(file: Any, source: Hdf5Events, camera: Camera, path: Path) -> None:
    """A stray event outside the sensor is ingest's to count; a share of them means another sensor's calibration."""
    x, y = (file[f"{source.group}/{c}"][:10_000] for c in "xy")
    outside = np.mean((x >= camera.width) | (y >= camera.height)) if len(x) else 0.0
    if outside > 0.01:
        raise CalibrationError(
            f"{path}: calibration does not fit: {100 * outside:.0f} % of the first events of /{source.group} "
            f"lie outside its {camera.width} x {camera.height} pixels"
        )


def _read_truth(file: Any, path: Path) -> Truth:
    shapes = {"t_us": None, "v_B": 3, "omega_B": 3, "q_WB_xyzw": 4}
    columns = {name: dataset(file, f"gt/{name}", path, width) for name, width in shapes.items()}
    if "p_WB" in file["gt"]:
        columns["p_WB"] = dataset(file, "gt/p_WB", path, 3)
    same_length(path, "gt", columns)
    values = {name: column[:].astype(np.float64) for name, column in columns.items() if name != "t_us"}
    return Truth(increasing_ns(columns["t_us"][:], path, "gt/t_us"), **values)


def write_recording(path: str | Path, data: SequenceData) -> None:
    """Store a sequence that is in memory; otherwise as RecordingWriter."""
    with RecordingWriter(path, data.calibration) as writer:
        writer.append("left", data.left)
        writer.append("right", data.right)
        writer.finish(data.imu, data.truth, data.depth)


class RecordingWriter:
    """Writes a sequence file bit by bit; it appears complete or not at all, and equal data give equal bytes.

    Without a ``calibration`` whoever reads the file has to name one. ``packed=False`` is for live sensors: four times
    the size, and many times as fast. Raises RecordingError for what the format cannot hold: cameras that differ or
    are not aligned, times that are not whole microseconds; and where the file cannot be written.
    """

    def __init__(self, path: str | Path, calibration: Calibration | None, *, packed: bool = True) -> None:
        self._path = Path(path)
        self._part = self._path.with_name(f"{self._path.name}.part{os.getpid()}")
        self._pending: dict[str, list[EventColumns]] = {"left": [], "right": []}
        self._finished = False
        if self._path.is_dir():
            raise RecordingError(f"{self._path}: cannot be written: is a directory")
        if self._path.parent.is_dir():
            self._require_space(0)
        try:
            self._file = h5py.File(self._part, "w")
        except OSError as e:
            raise RecordingError(
                f"{self._path}: cannot be written: {os.strerror(e.errno) if e.errno else e}"
            ) from None
        try:
            if calibration is not None:
                _write_calibration(self._file, calibration, self._path)
        except RecordingError:
            self.close()
            raise
        options = _PACKED if packed else {}
        for side in self._pending:
            for name, kind in _EVENT_COLUMNS.items():
                self._file.create_dataset(
                    f"events/{side}/{name}", (0,), kind, maxshape=(None,), chunks=(_CHUNK,), **options
                )

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def append(self, side: str, events: EventColumns) -> None:
        """Add events of the ``"left"`` or ``"right"`` camera, in time order."""
        self._pending[side].append(events)
        if sum(len(part.t_ns) for part in self._pending[side]) >= _CHUNK:
            self._flush(side)

    def append_imu(self, imu: Imu) -> None:
        """Add samples of the IMU, in time order, where they come bit by bit as well."""
        columns = {"t_us": _microseconds(imu.t_ns, self._path), "accel": imu.accel, "gyro": imu.gyro}
        for name, values in columns.items():
            if f"imu/{name}" not in self._file:
                shape = values.shape[1:]
                self._file.create_dataset(
                    f"imu/{name}", (0, *shape), values.dtype, maxshape=(None, *shape), chunks=(_IMU_CHUNK, *shape)
                )
            _extend(self._file[f"imu/{name}"], values)

    def finish(self, imu: Imu | None, truth: Truth | None = None, depth: DepthTruth | None = None) -> None:
        """Add the rest and put the file in its place; no ``imu`` where ``append_imu`` was given it."""
        for side in self._pending:
            self._flush(side)
        if imu is not None:
            self._write_group("imu", imu.t_ns, accel=imu.accel, gyro=imu.gyro)
        if truth is not None:
            position = {} if truth.p_WB is None else {"p_WB": truth.p_WB}
            self._write_group(
                "gt", truth.t_ns, v_B=truth.v_B, omega_B=truth.omega_B, q_WB_xyzw=truth.q_WB_xyzw, **position
            )
        if depth is not None:
            self._require_space(depth.left.nbytes)
            self._write_group("depth", depth.t_ns)
            self._file.create_dataset("depth/left", data=depth.left, **_PACKED)
        self._finished = True

    def close(self) -> None:
        """Without ``finish`` before it nothing is left behind."""
        try:
            self._file.close()
            if self._finished:
                self._part.replace(self._path)
        except OSError as e:
            raise RecordingError(f"{self._path}: cannot be written: {e.strerror or e}") from None
        finally:
            self._part.unlink(missing_ok=True)

    def _flush(self, side: str) -> None:
        parts, self._pending[side] = self._pending[side], []
        if not parts:
            return
        t_us = _microseconds(np.concatenate([part.t_ns for part in parts]), self._path)
        self._require_space(len(t_us) * sum(np.dtype(kind).itemsize for kind in _EVENT_COLUMNS.values()))
        x, y, p = (np.concatenate([getattr(part, name) for part in parts]) for name in "xyp")
        for name, column in (("x", x), ("y", y), ("t", t_us), ("p", p)):
            _extend(self._file[f"events/{side}/{name}"], column)

    def _require_space(self, n_bytes: int) -> None:
        if shutil.disk_usage(self._path.absolute().parent).free < n_bytes + _SPARE_BYTES:
            raise RecordingError(f"{self._path}: cannot be written: no space left on the disk")

    def _write_group(self, name: str, t_ns: I64, **columns: F64) -> None:
        group = self._file.create_group(name)
        group["t_us"] = _microseconds(t_ns, self._path)
        for column, values in columns.items():
            group[column] = values


def _extend(stored: Any, values: Any) -> None:
    stored.resize(len(stored) + len(values), axis=0)
    stored[len(stored) - len(values) :] = values


def _write_calibration(file: Any, calibration: Calibration, path: Path) -> None:
    camera = calibration.left
    if calibration.right != camera or not np.array_equal(calibration.R_RL, np.eye(3)) or calibration.t_RL[1:].any():
        raise RecordingError(f"{path}: a sequence file holds two equal, aligned cameras only")
    attrs = file.create_group("calib").attrs
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        attrs[name] = getattr(camera, name)
    attrs["baseline_m"] = -float(calibration.t_RL[0])
    attrs["T_cam_imu"] = calibration.T_cam_imu
    attrs["time_offset_s"] = calibration.time_offset_s
    if camera.model != "none":
        attrs[f"dist_{camera.model}"] = np.asarray(camera.dist)


def _microseconds(t_ns: I64, path: Path) -> I64:
    t_us, rest = np.divmod(t_ns, 1000)
    if rest.any():
        raise RecordingError(f"{path}: times must be whole microseconds")
    whole: I64 = t_us
    return whole
