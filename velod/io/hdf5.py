"""What the HDF5 readers share: opening, columns, events in blocks, IMU; with errors that name file and cause."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from velod.geometry.calibration import CalibrationError
from velod.io.model import EventColumns, Imu, RecordingError
from velod.types import I64, U8

BLOCK = 1 << 18
"""Events read at a time."""
_SHORTEST_STEP_US = 10.0
"""No IMU is faster than 100 kHz on average."""

# What h5py raises over a damaged file, and numpy over what it read from one.
_LIBRARY_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError, MemoryError)


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """An open file; errors of the library inside the block, of whatever kind, become one RecordingError."""
    if not path.is_file():
        raise RecordingError(f"{path}: no such file")
    _register_filters()
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (RecordingError, CalibrationError):
        raise
    except _LIBRARY_ERRORS as e:
        raise RecordingError(f"{path}: {_cause(path, str(e))}") from None


def _register_filters() -> None:
    """hdf5plugin, when installed, teaches the library blosc and others by being imported."""
    try:
        import hdf5plugin  # noqa: F401
    except ImportError:
        return


def _cause(path: Path, message: str) -> str:
    if "truncated" in message:
        return "truncated HDF5 file (was the copy interrupted?)"
    if "signature not found" in message:
        return "not an HDF5 file"
    if "filter returned failure" in message:
        return "damaged: what is stored cannot be decompressed"
    if "filter" in message.lower():
        return "compressed with a filter that is not installed: pip install 'velod[h5]'"
    return f"cannot be read: {message.splitlines()[0] if message else 'unknown cause'}"


def dataset(file: Any, name: str, path: Path, columns: int | None = None) -> Any:
    """A dataset of shape (n,) or, with ``columns``, (n, columns). Raises RecordingError if it is missing or not."""
    found = file.get(name)
    if not isinstance(found, h5py.Dataset):
        raise RecordingError(f"{path}: dataset /{name} is missing")
    expected = "(n,)" if columns is None else f"(n, {columns})"
    if found.ndim != (1 if columns is None else 2) or (columns is not None and found.shape[1] != columns):
        raise RecordingError(f"{path}: /{name} has shape {found.shape}, expected {expected}")
    return found


def same_length(path: Path, group: str, columns: dict[str, Any]) -> int:
    """The common length of the columns of a group."""
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise RecordingError(f"{path}: columns of /{group} differ in length: {told}")
    return next(iter(lengths.values()))


def increasing_ns(t_us: Any, path: Path, name: str) -> I64:
    """File microseconds, whole or with fractions -> ns; they must increase, and be microseconds."""
    t_us = np.asarray(t_us)
    if t_us.dtype.kind != "f":
        t_ns: I64 = t_us.astype(np.int64) * 1000
    elif not np.isfinite(t_us).all():
        raise RecordingError(f"{path}: /{name} holds times that are not finite")
    elif len(t_us) > 1 and 0.0 <= t_us[-1] - t_us[0] < _SHORTEST_STEP_US * (len(t_us) - 1):
        raise RecordingError(
            f"{path}: /{name} spans {t_us[-1] - t_us[0]:g} us with {len(t_us)} times: are they seconds?"
        )
    else:
        t_ns = np.rint(t_us * 1000.0).astype(np.int64)
    step = np.diff(t_ns)
    if len(step) and step.min() <= 0:
        i = int(np.argmax(step <= 0)) + 1
        raise RecordingError(
            f"{path}: /{name} does not increase at sample {i} ({t_ns[i - 1] // 1000} us, then {t_ns[i] // 1000} us)"
        )
    return t_ns


def read_imu(file: Any, path: Path) -> Imu:
    """``/imu/{t_us, accel, gyro}``. NaN in the samples is left to ingest, which counts and drops it."""
    if "imu" not in file:
        raise RecordingError(f"{path}: no IMU (/imu is missing): velod needs one beside the stereo cameras")
    t_us = dataset(file, "imu/t_us", path)
    accel = dataset(file, "imu/accel", path, 3)
    gyro = dataset(file, "imu/gyro", path, 3)
    if same_length(path, "imu", {"t_us": t_us, "accel": accel, "gyro": gyro}) == 0:
        raise RecordingError(f"{path}: no IMU samples: velod needs an IMU beside the stereo cameras")
    return Imu(increasing_ns(t_us[:], path, "imu/t_us"), accel[:].astype(np.float64), gyro[:].astype(np.float64))


@dataclass(frozen=True, slots=True)
class Hdf5Events:
    """``<group>/{x, y, t, p}`` of one file; t in us after ``offset_us``."""

    name: str
    n_events: int
    first_t_ns: int
    last_t_ns: int
    path: Path
    group: str
    offset_us: int

    @staticmethod
    def open(file: Any, path: Path, group: str, offset_us: int = 0) -> Hdf5Events:
        """Columns x, y, t, p of ``group``; ``offset_us`` is added to t, both in us. Raises RecordingError."""
        columns = {c: dataset(file, f"{group}/{c}", path) for c in "xytp"}
        for c, column in columns.items():
            if column.dtype.kind not in "iub":
                raise RecordingError(f"{path}: /{group}/{c} holds {column.dtype}, expected integers")
        n = same_length(path, group, columns)
        t = columns["t"]
        first, last = ((int(t[i]) + offset_us) * 1000 for i in (0, -1)) if n else (0, 0)
        return Hdf5Events(f"{path}:/{group}", n, first, last, path, group, offset_us)

    def blocks(self) -> Iterator[EventColumns]:
        """Consecutive blocks in file order. Raises RecordingError."""
        with opened(self.path) as file:
            x, y, t, p = (file[f"{self.group}/{c}"] for c in "xytp")
            for start in range(0, self.n_events, BLOCK):
                part = slice(start, start + BLOCK)
                yield EventColumns(
                    (t[part].astype(np.int64) + self.offset_us) * 1000,
                    pixels(x[part], f"{self.name}/x"),
                    pixels(y[part], f"{self.name}/y"),
                    polarities(p[part]),
                )


def polarities(values: Any) -> U8:
    """Polarities as u8, 1 = ON, 0 = OFF; some tools write OFF as -1. What else there is, ingest counts and drops."""
    return np.where(values == -1, 0, values).astype(np.uint8)


def pixels(values: Any, name: str) -> Any:
    """Pixel coordinates as u16. Raises RecordingError where a value does not fit."""
    if values.dtype != np.uint16 and len(values) and (values.min() < 0 or values.max() > 0xFFFF):
        raise RecordingError(f"{name}: pixel coordinates outside 0..65535")
    return values.astype(np.uint16, copy=False)
