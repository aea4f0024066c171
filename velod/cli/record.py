"""``velod record``: what a rig sends, into a file, until Ctrl-C."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event

from velod import __version__
from velod.cli.config import calibration_of, settings_of
from velod.cli.exit import EXIT_FAILED, RunFailed
from velod.cli.line import Line
from velod.cli.place import Place, Way, place_of
from velod.cli.values import require_writable
from velod.client import Listener, Received
from velod.geometry.calibration import Calibration, CalibrationError
from velod.geometry.calibration_files import save_calibration
from velod.io.live import SensorLog
from velod.io.model import RecordingError
from velod.runtime.session import open_session
from velod.runtime.settings_service import NoServiceError, fetch
from velod.runtime.worker import stop_on_signals
from velod.wire.topics import EVENTS, HEALTH, IMU_SENSOR, ODOMETRY, TOPICS, VELOCITY, Topic

SEQUENCE_SUFFIXES, MCAP_SUFFIX = (".h5", ".hdf5"), ".mcap"
OUTPUTS = (VELOCITY, ODOMETRY, HEALTH)
MIN_FREE_BYTES = 256 << 20
"""Recording ends while there is room left to close the file, and for everybody else."""
QUEUE_BYTES = 256 << 20
"""Of each topic, while the disk is slow: five seconds of 5 Mev/s."""
_POLL_S = 0.1
_LOOK_S = 1.0


def record(
    config: str | None, file: str, topics: list[str], way: Way, calibration: str | None, seconds: float | None
) -> int:
    """Write until ``seconds`` have passed since the first message, SIGINT or SIGTERM; 1 where something was lost.

    Raises ValueError, OSError, RunFailed.
    """
    path = Path(file)
    if path.exists():
        raise ValueError(f"{path}: exists already; velod overwrites no recording")
    require_writable(file)
    chosen = _topics(path, topics)
    place = place_of(config, way, "operator")
    session = Session(place, chosen, seconds, stop_on_signals())
    if path.suffix in SEQUENCE_SUFFIXES:
        _record_sensors(path, session, _calibration(config, calibration, place))
    else:
        _record_mcap(path, session)
    return session.report(path)


def _topics(path: Path, names: list[str]) -> tuple[Topic, ...]:
    if path.suffix not in (*SEQUENCE_SUFFIXES, MCAP_SUFFIX):
        raise ValueError(f"{path}: must end in .h5 (sensor streams, for velod replay) or .mcap (any topics)")
    if path.suffix in SEQUENCE_SUFFIXES:
        if names:
            raise ValueError(
                f"{path}: a sequence file holds the sensor streams and nothing else; topics go with .mcap"
            )
        return EVENTS, IMU_SENSOR
    known = [t.name for t in TOPICS.values() if t.message is not None]
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"no topic {unknown[0]!r} to record; topics: {', '.join(known)}")
    return tuple(TOPICS[name] for name in names) or OUTPUTS


@dataclass(slots=True)
class Session:
    """One recording: takes messages in, shows how far it is, and knows when it is over."""

    place: Place
    topics: tuple[Topic, ...]
    seconds: float | None
    stop: Event
    n: int = 0
    n_bytes: int = 0
    began_s: float = 0.0  # when the first message came
    lost: dict[str, int] = field(default_factory=dict)
    ended: str = ""  # why, if not as was asked

    def run(self, path: Path, take: Callable[[Received], None]) -> None:
        """Hand every message to ``take`` until it is over."""
        line, next_look_s = Line(), 0.0
        with Listener(self.place.rig, self.topics, self.place.zenoh, QUEUE_BYTES) as listener:
            print(f"recording rig {self.place.rig} ({self.place.connect}); Ctrl-C ends", file=sys.stderr, flush=True)
            while not self._is_over():
                if (received := listener.receive(_POLL_S)) is not None:
                    self._hand_over(received, take)
                if line.due():
                    line.draw(self._progress(listener.counters))
                if (now_s := time.monotonic()) >= next_look_s:
                    next_look_s = now_s + _LOOK_S
                    self._look_at_disk(path)
            end_ns = time.time_ns()  # what has come until now may still wait in the queue
            while (received := listener.receive(0.0)) is not None and received.t_received_ns <= end_ns:
                self._hand_over(received, take)
            self.lost = _losses(listener.counters)
        line.finish()
        if not self.n:
            raise RunFailed(f"nothing came from rig {self.place.rig} ({self.place.connect})")

    def _hand_over(self, received: Received, take: Callable[[Received], None]) -> None:
        take(received)
        self.n, self.n_bytes = self.n + 1, self.n_bytes + received.n_bytes
        self.began_s = self.began_s or time.monotonic()

    def report(self, path: Path) -> int:
        """Say what was recorded and what is missing; the exit code."""
        elapsed_s = time.monotonic() - self.began_s
        print(f"wrote {path}: {self.n} messages in {elapsed_s:.1f} s, {_megabytes(path.stat().st_size)}")
        if self.lost:
            print(f"velod: lost: {', '.join(f'{k} {n}' for k, n in sorted(self.lost.items()))}", file=sys.stderr)
        if self.ended:
            print(f"velod: ended early: {self.ended}", file=sys.stderr)
        return EXIT_FAILED if self.lost or self.ended else 0

    def _is_over(self) -> bool:
        late = self.seconds is not None and self.n > 0 and time.monotonic() - self.began_s >= self.seconds
        return late or bool(self.ended) or self.stop.is_set()

    def _look_at_disk(self, path: Path) -> None:
        if (free := shutil.disk_usage(path.absolute().parent).free) < MIN_FREE_BYTES:
            self.ended = f"{_megabytes(free)} left on the disk"

    def _progress(self, counters: dict[str, int]) -> str:
        if not self.n:
            return "nothing has come yet"
        elapsed_s = time.monotonic() - self.began_s
        return (
            f"{elapsed_s:7.1f} s  {self.n} messages  {_megabytes(self.n_bytes)}"
            f"  {_megabytes(self.n_bytes / max(elapsed_s, 0.1))}/s  lost {sum(_losses(counters).values())}"
        )


def _losses(counters: dict[str, int]) -> dict[str, int]:
    """Of a listener's counters, those of messages that are missing; what overflowed is a gap as well."""
    return {name: n for name, n in counters.items() if n and name.startswith(("gap.", "wire.", "back_in_time."))}


def _megabytes(n: float) -> str:
    return f"{n / 1e6:.1f} MB"


def _record_sensors(path: Path, session: Session, calibration: Calibration | None) -> None:
    beside = path.with_suffix(".yaml")
    try:
        log = SensorLog(path, calibration)
    except RecordingError:
        # Real cameras are not equal, which the format does not hold: the calibration goes into a file of its own.
        log = SensorLog(path, None)
        assert calibration is not None
        save_calibration(beside, calibration)
        print(f"wrote {beside}: replay with --calibration {beside}")
    with log:
        session.run(path, lambda received: log.add(received.envelope.message))  # type: ignore[arg-type]
        session.lost |= log.counters
        log.finish()


def _record_mcap(path: Path, session: Session) -> None:
    try:
        from velod.io.mcap_log import McapLog
    except ImportError:
        raise ValueError(".mcap files need the package mcap: pip install 'velod[mcap]'") from None
    place = session.place
    with McapLog(path, {"rig": place.rig, "velod": __version__}) as log:
        try:
            session.run(path, lambda r: log.add(r.key, r.envelope, r.t_received_ns))
        except RunFailed:
            path.unlink()  # the file holds nothing
            raise


def _calibration(config: str | None, file: str | None, place: Place) -> Calibration | None:
    """Of the file or the settings; else of the service, which may not be there: a driver is enough to record."""
    if (named := calibration_of(settings_of(config, file))) is not None:
        return named
    try:
        with open_session(place.zenoh) as session:
            return fetch(session, place.rig, place.connect)[1]
    except (NoServiceError, CalibrationError) as e:
        print(f"velod: no calibration in the file: {e}; replay it with --calibration FILE", file=sys.stderr)
        return None
