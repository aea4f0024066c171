"""Sensor messages into a sequence file while they come: what ``velod replay`` plays again."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import numpy as np

from velod.geometry.calibration import Calibration
from velod.io.model import EventColumns, Imu, RecordingError
from velod.io.sequence import RecordingWriter
from velod.types import I64, EventPacket, ImuPacket

_CAMERAS = ("left", "right")
_US = 1000


class SensorLog:
    """A context manager; the file appears complete with ``finish``, or not at all.

    Times become whole microseconds (rounded down). Whatever goes back in time is left out, because no reader would
    take it: a driver that was restarted with another clock. ``counters`` says how much.
    """

    def __init__(self, path: str | Path, calibration: Calibration | None) -> None:
        """Raises RecordingError: cannot be written, or a calibration that the format cannot hold."""
        self._path = Path(path)
        self._writer = RecordingWriter(path, calibration, packed=False)
        self._newest_ns = dict.fromkeys((*_CAMERAS, "imu"), -(2**62))
        self.counters: dict[str, int] = {}
        self.n_events = dict.fromkeys(_CAMERAS, 0)
        self.n_imu = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._writer.close()

    def add(self, message: EventPacket | ImuPacket) -> None:
        """One packet, in the order in which its driver sent it. Raises RecordingError where the disk refuses it."""
        try:
            if isinstance(message, EventPacket):
                self._add_events(message)
            else:
                self._add_imu(message)
        except OSError as e:
            raise RecordingError(f"{self._path}: cannot be written: {e.strerror or e}") from None

    def finish(self) -> None:
        """Put the file in its place. Raises RecordingError where a stream is missing without which nothing plays."""
        missing = [f"{camera} events" for camera, n in self.n_events.items() if not n]
        if not self.n_imu:
            missing.append("IMU samples")
        if missing:
            raise RecordingError(f"{self._path}: not written: no {', no '.join(missing)} came")
        self._writer.finish(None)

    def _add_events(self, packet: EventPacket) -> None:
        t_ns = _whole_us(packet.event_t_ns)
        if not len(t_ns):
            return
        if t_ns[0] < self._newest_ns[packet.camera] or (np.diff(t_ns) < 0).any():
            self._count(f"back_in_time.{packet.camera}", len(t_ns))
            return
        self._newest_ns[packet.camera] = int(t_ns[-1])
        self.n_events[packet.camera] += len(t_ns)
        self._writer.append(packet.camera, EventColumns(t_ns, packet.x, packet.y, packet.p))

    def _add_imu(self, packet: ImuPacket) -> None:
        t_ns = _whole_us(packet.sample_t_ns)
        newest_before = np.maximum.accumulate(np.concatenate(([self._newest_ns["imu"]], t_ns)))[:-1]
        good = t_ns > newest_before
        self._count("back_in_time.imu", int(np.sum(~good)))
        if good.any():
            self._newest_ns["imu"] = int(t_ns[good][-1])
            self.n_imu += int(np.sum(good))
            self._writer.append_imu(Imu(t_ns[good], packet.accel[good], packet.gyro[good]))

    def _count(self, name: str, n: int) -> None:
        if n:
            self.counters[name] = self.counters.get(name, 0) + n


def _whole_us(t_ns: I64) -> I64:
    whole: I64 = t_ns // _US * _US
    return whole
