"""Open a recording, whatever its format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py

from velod.geometry.calibration import Calibration
from velod.io import dsec, sequence, text
from velod.io.model import EventSource, Imu, RecordingError, Truth
from velod.io.packets import Chunking, packets
from velod.types import NS_PER_S, EventPacket, ImuPacket

FORMATS = ("sequence", "dsec", "text")

_HDF5_SUFFIXES = (".h5", ".hdf5")

_MIN_IMU_HZ = 10.0
"""Over the whole recording. IMUs give 100 Hz and more; times in a wrong unit, or one that leaps, give nearly none."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording that was opened and checked; its events are read only as ``packets`` walks through them."""

    path: Path
    calibration: Calibration
    left: EventSource
    right: EventSource
    imu: Imu
    truth: Truth | None

    @property
    def t_start_ns(self) -> int:
        """Sensor time of the first event or IMU sample."""
        return min(self.left.first_t_ns, self.right.first_t_ns, int(self.imu.t_ns[0]))

    @property
    def t_end_ns(self) -> int:
        """Sensor time of the last event or IMU sample."""
        return max(self.left.last_t_ns, self.right.last_t_ns, int(self.imu.t_ns[-1]))

    @property
    def duration_s(self) -> float:
        """From its start to its end in sensor time, s."""
        return (self.t_end_ns - self.t_start_ns) / NS_PER_S

    @property
    def n_events(self) -> int:
        """Events of both cameras."""
        return self.left.n_events + self.right.n_events

    def packets(self, chunking: Chunking | None = None) -> Iterator[EventPacket | ImuPacket]:
        """What a driver would publish, in sensor-time order (default: 200 packets a second and camera).

        The same recording and chunking give the same packets. Raises RecordingError where times go backwards or
        the file cannot be read any further.
        """
        return packets(self.left, self.right, self.imu, self.t_start_ns, self.t_end_ns, chunking or Chunking())


def open_recording(
    path: str | Path,
    format: str | None = None,
    *,
    right: str | Path | None = None,
    calibration: Calibration | None = None,
) -> Recording:
    """Open a sequence file (HDF5), a DSEC directory or a directory of the Event-Camera Dataset (text).

    ``format``: one of FORMATS; None: from what is there. ``right``: directory of the right camera (text only).
    ``calibration`` replaces the recording's own. Raises RecordingError naming file and cause, CalibrationError.
    """
    path = Path(path)
    if not path.exists():
        raise RecordingError(f"{path}: no such file or directory")
    kind = format or _guess(path)
    if kind == "sequence":
        parts = sequence.read(path, calibration)
    elif kind == "dsec":
        parts = dsec.read(path, calibration)
    elif kind == "text":
        parts = text.read(path, None if right is None else Path(right), calibration)
    else:
        raise RecordingError(f"{path}: unknown format {kind!r}; known: {', '.join(FORMATS)}")
    recording = Recording(path, parts.calibration, parts.left, parts.right, parts.imu, parts.truth)
    _check_times(recording)
    return recording


def _guess(path: Path) -> str:
    if path.is_file():
        if path.name == "events.txt":
            raise RecordingError(f"{path}: one file of a recording, which is the folder {path.parent}")
        if path.suffix not in _HDF5_SUFFIXES and not h5py.is_hdf5(path):
            raise RecordingError(f"{path}: not a recording: neither an HDF5 file nor a folder (DSEC, text)")
        return "sequence"
    if (path / "events" / "left").is_dir():
        return "dsec"
    if (path / "events.txt").is_file() or (path / "left" / "events.txt").is_file():
        return "text"
    raise RecordingError(
        f"{path}: not a recording: neither events/left/events.h5 (DSEC) nor events.txt (text) is there"
    )


def _check_times(recording: Recording) -> None:
    for source in (recording.left, recording.right):
        if source.n_events == 0:
            raise RecordingError(f"{source.name}: no events")
        if source.last_t_ns < source.first_t_ns:
            raise RecordingError(
                f"{source.name}: event times go backwards: the first is {source.first_t_ns / 1e9:.3f} s, the last "
                f"{source.last_t_ns / 1e9:.3f} s; a counter that rolled over, or columns in another order?"
            )
        if source.first_t_ns > int(recording.imu.t_ns[-1]) or source.last_t_ns < int(recording.imu.t_ns[0]):
            raise RecordingError(
                f"{recording.path}: clocks differ: events of {source.name} span "
                f"{source.first_t_ns / 1e9:.3f} to {source.last_t_ns / 1e9:.3f} s, the IMU "
                f"{recording.imu.t_ns[0] / 1e9:.3f} to {recording.imu.t_ns[-1] / 1e9:.3f} s"
            )
    n_imu = len(recording.imu.t_ns)
    if n_imu < _MIN_IMU_HZ * recording.duration_s - 1.0:
        raise RecordingError(
            f"{recording.path}: {n_imu} IMU samples over {recording.duration_s:g} s: are the times in the format's "
            "unit (text: s, HDF5: us), and does none of them leap?"
        )
