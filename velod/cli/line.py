"""What the commands show while they work: a line of the terminal that is drawn over and over."""

from __future__ import annotations

import logging
import math
import shutil
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator
from threading import Lock
from typing import Self

from velod.cli.exit import raise_if_interrupted
from velod.cli.words import describe_velocity
from velod.types import EventPacket, ImuPacket, Velocity

_REDRAW_S = 0.1


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


class Bar:
    """A progress bar on stderr for work that tells its share; one plain line where that is no terminal.

    Work that need not be done, and tells no share, is not mentioned.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._line = Line()
        self._start_s = time.monotonic()
        self._said = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._line.finish()

    def show(self, share: float) -> None:
        raise_if_interrupted()
        if not self._line.enabled and not self._said:
            print(self._what, file=sys.stderr)
            self._said = True
        if self._line.due():
            self._line.draw(f"{self._what} {progress_bar(share, time.monotonic() - self._start_s)}")


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
