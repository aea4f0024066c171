"""What the commands show and write: a live line, a progress bar, CSV and JSON files."""

from __future__ import annotations

import csv
import json
import logging
import math
import shutil
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any, TextIO

import numpy as np

from velod.cli.exit import raise_if_interrupted
from velod.types import EventPacket, ImuPacket, Velocity

CSV_COLUMNS = (
    *("t_ns", "vx", "vy", "vz"),
    *("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"),
    *("state", "valid", "age_ms"),
    *("bridged_ms", "up_x", "up_y", "up_z", "up_sigma", "frame", "degenerate"),
)
"""Velocity in m/s in B, covariance in (m/s)^2, up in B with the larger sigma of its direction in rad; age_ms: from
sensor time to publication; bridged_ms: how far the IMU carried the newest measurement."""

_REDRAW_S = 0.1
_UPPER = np.triu_indices(3)


@contextmanager
def _written(path: str) -> Iterator[TextIO]:
    """A text file to write; what fails while it is written, such as a full disk, names it too. Raises OSError."""
    try:
        with Path(path).open("w", newline="", encoding="utf-8") as f:
            yield f
    except OSError as e:
        raise OSError(e.errno, e.strerror, path) from None


def write_csv(path: str, velocities: Sequence[Velocity]) -> None:
    """One line per velocity; numbers that read back exactly; what is not known is empty."""
    with _written(path) as f:
        writer = csv.writer(f)
        writer.writerow(CSV_COLUMNS)
        for v in velocities:
            bridged_ms = math.nan if v.batch_seq < 0 else (v.t_ns - v.batch_t_ns) / 1e6
            further = [_number(a) for a in (v.age_ms, bridged_ms, *v.up_B, up_sigma(v))]
            numbers = [repr(float(a)) for a in (*v.v_B, *v.cov[_UPPER])]
            writer.writerow([v.t_ns, *numbers, v.state, int(v.valid), *further, v.frame, v.degenerate])


def _number(a: float) -> str:
    return repr(float(a)) if math.isfinite(a) else ""


def write_json(path: str, value: Any) -> None:
    """JSON into a file, or onto stdout for ``-``. NaN is refused: the caller writes null."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    if path == "-":
        sys.stdout.write(text)
    else:
        with _written(path) as f:
            f.write(text)


class Line:
    """One line of a terminal that is drawn over and over; silent where stderr is not a terminal."""

    def __init__(self) -> None:
        self.enabled = sys.stderr.isatty()
        self._next_s = 0.0
        self._text = ""
        self._lock = Lock()  # log lines come from other threads

    def due(self) -> bool:
        """Whether it is time to draw again."""
        return self.enabled and time.monotonic() >= self._next_s

    def draw(self, text: str) -> None:
        """Show ``text`` in place of what was there."""
        self._next_s = time.monotonic() + _REDRAW_S
        # A line that wraps could not be drawn over.
        text = text[: shutil.get_terminal_size().columns - 1]
        with self._lock:
            self._text = text
            self._write(f"\r\x1b[K{text}")

    def log(self, text: str) -> None:
        """Write a line of its own above the live one."""
        with self._lock:
            self._write(f"\r\x1b[K{text}\n{self._text}" if self._text else f"{text}\n")

    def log_trouble(self, text: str) -> None:
        """Write a process's log line unless it only says that all goes well."""
        if " INFO " not in text:
            self.log(text)

    def finish(self) -> None:
        """Leave the last state on the screen and go to the next line."""
        with self._lock:
            if self._text:
                self._write("\n")
            self._text = ""

    @staticmethod
    def _write(text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()


def log_above(line: Line) -> None:
    """Send this process's own warnings above the live line."""

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            line.log(self.format(record))

    logging.basicConfig(level=logging.WARNING, handlers=[Handler()], format="%(levelname)s %(message)s", force=True)


class VelocityLine:
    """The live line of a run: rate, speed with its sigma, latency and state."""

    def __init__(self) -> None:
        self.line = Line()
        self._times_s: deque[float] = deque(maxlen=75)

    def show(self, v: Velocity, latency_ms: float) -> None:
        """Note a velocity, and draw it if it is time to."""
        self._times_s.append(time.monotonic())
        if self.line.due():
            self.line.draw(describe_velocity(v, self._rate_hz(), latency_ms))

    def _rate_hz(self) -> float:
        span_s = self._times_s[-1] - self._times_s[0]
        return (len(self._times_s) - 1) / span_s if span_s > 0.0 else math.nan


def describe_velocity(v: Velocity, rate_hz: float = math.nan, latency_ms: float = math.nan) -> str:
    """One line for people, e.g. ``t  12.345 s  |v|  5.678 +- 0.031 m/s  [...]  75.0 Hz  8.1 ms  tracking``."""
    parts = [f"t {v.t_ns * 1e-9:9.3f} s"]
    if v.valid:
        speed, sigma = speed_and_sigma(v)
        parts.append(f"|v| {speed:6.3f} ± {sigma:.3f} m/s  [{v.v_B[0]:+.3f} {v.v_B[1]:+.3f} {v.v_B[2]:+.3f}]")
    else:
        parts.append("|v|    --")
    if math.isfinite(rate_hz):
        parts.append(f"{rate_hz:5.1f} Hz")
    if math.isfinite(latency_ms):
        parts.append(f"{latency_ms:5.1f} ms")
    parts.append(f"{v.state}: {v.reason}" if v.reason else str(v.state))
    return "  ".join(parts)


def speed_and_sigma(v: Velocity) -> tuple[float, float]:
    """|v| and its standard deviation to first order, m/s."""
    speed = float(np.linalg.norm(v.v_B))
    along = v.v_B / speed if speed > 1e-9 else np.full(3, math.sqrt(1.0 / 3.0))
    return speed, math.sqrt(max(0.0, float(along @ v.cov @ along)))


def describe_attitude(v: Velocity) -> str:
    """Frame, up and age, for people, e.g. ``imu  up [+0.00 -1.00 +0.02] ± 0.4°  age 23.1 ms``."""
    parts = [v.frame]
    if math.isfinite(sigma := up_sigma(v)):
        parts.append(f"up [{v.up_B[0]:+.2f} {v.up_B[1]:+.2f} {v.up_B[2]:+.2f}] ± {math.degrees(sigma):.1f}°")
    if math.isfinite(v.age_ms):
        parts.append(f"age {v.age_ms:.1f} ms")
    return "  ".join(parts)


def up_sigma(v: Velocity) -> float:
    """Of the direction of up in B, where it is known worst, rad; NaN where up is not known."""
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(v.up_cov)[-1]))) if np.isfinite(v.up_cov).all() else math.nan


def with_progress(
    packets: Iterable[EventPacket | ImuPacket], t_start_ns: int, t_end_ns: int
) -> Iterator[EventPacket | ImuPacket]:
    """The packets, while a bar on stderr shows how far into the recording they are."""
    line = Line()
    start_s = time.monotonic()
    for packet in packets:
        raise_if_interrupted()
        yield packet
        if line.due():
            done_ns = min(packet.t_ns, t_end_ns) - t_start_ns
            line.draw(progress_bar(done_ns / max(1, t_end_ns - t_start_ns), time.monotonic() - start_s))
    line.finish()


def progress_bar(share: float, elapsed_s: float, width: int = 40) -> str:
    """``[#####.....]  50 %  12 s left``"""
    share = min(1.0, max(0.0, share))
    filled = round(share * width)
    left = f"{elapsed_s / share - elapsed_s:4.0f} s left" if share > 0.02 else ""
    return f"[{'#' * filled}{'.' * (width - filled)}] {100.0 * share:3.0f} %  {left}".rstrip()
