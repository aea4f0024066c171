"""A child process of the supervisor: started, listened to, stopped, and asked why it died."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import IO

TAIL_LINES = 3
_LOG_READ_S = 0.2

LineSink = Callable[[str], None]


def to_stderr(line: str) -> None:
    """Pass a log line on, in one piece: several threads do."""
    sys.stderr.write(f"{line}\n")
    sys.stderr.flush()


class ChildProcess:
    """One child. Its log lines go to ``on_line``; the last ones are kept to tell why it died.

    It has a process group of its own, so that Ctrl-C in the terminal reaches the supervisor alone, which then stops
    its children in good order; not a session of its own, because schedulers may share out the time by sessions first,
    and then low priority means nothing between processes.
    """

    def __init__(self, command: Sequence[str], on_line: LineSink = to_stderr) -> None:
        self.started_s = time.monotonic()
        self._tail: deque[str] = deque(maxlen=TAIL_LINES)
        self._said: set[str] = set()
        self._on_line = on_line
        self._popen = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=_environment(),
            process_group=0,
            text=True,
            errors="replace",
        )
        self._readers = [
            threading.Thread(target=self._read_log, args=(self._popen.stderr,), daemon=True),
            threading.Thread(target=self._read_words, args=(self._popen.stdout,), daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._popen.pid

    def has_said(self, word: str) -> bool:
        """Whether it has printed this line on stdout."""
        return word in self._said

    def exit_code(self) -> int | None:
        """None while it runs; negative: the signal that ended it."""
        return self._popen.poll()

    def why(self) -> str:
        """How it ended, in words, with its last log lines."""
        code = self._popen.poll()
        if code is None:
            return "still running"
        for reader in self._readers:
            reader.join(_LOG_READ_S)
        how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return f"{how}; last lines: " + " | ".join(self._tail) if self._tail else how

    def tell(self, order: dict[str, str]) -> bool:
        """Write one line of JSON to its stdin; False if it is gone."""
        assert self._popen.stdin is not None
        try:
            self._popen.stdin.write(json.dumps(order) + "\n")
            self._popen.stdin.flush()
        except OSError:
            return False
        return True

    def terminate(self) -> None:
        """Ask it to end (SIGTERM), even if it is stopped."""
        self._signal(signal.SIGTERM)
        self._signal(signal.SIGCONT)

    def kill(self) -> None:
        """End it."""
        self._signal(signal.SIGKILL)

    def wait(self, timeout_s: float) -> bool:
        """Wait for its end; False if it still runs after ``timeout_s``."""
        try:
            self._popen.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> None:
        """Free the pipes of a process that has ended."""
        for reader in self._readers:
            reader.join(_LOG_READ_S)
        for pipe in (self._popen.stdin, self._popen.stdout, self._popen.stderr):
            if pipe is not None:
                try:
                    pipe.close()
                except OSError:
                    continue  # an order that was never read; its reader is gone

    def _signal(self, number: signal.Signals) -> None:
        if self._popen.poll() is None:
            self._popen.send_signal(number)

    def _read_log(self, pipe: IO[str]) -> None:
        for line in pipe:
            self._tail.append(line.rstrip())
            self._on_line(line.rstrip())

    def _read_words(self, pipe: IO[str]) -> None:
        for line in pipe:
            self._said.add(line.strip())


def stop_all(children: Sequence[ChildProcess], patience_s: float = 3.0) -> None:
    """SIGTERM to all, SIGKILL to those that have not ended after ``patience_s``; returns when none is left."""
    for child in children:
        child.terminate()
    deadline_s = time.monotonic() + patience_s
    for child in children:
        if not child.wait(max(0.0, deadline_s - time.monotonic())):
            child.kill()
            child.wait(patience_s)
        child.close()


def _environment() -> dict[str, str]:
    """Of a worker: one thread for linear algebra, because the parallelism is in the processes."""
    single = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return {**os.environ, **single, "PYTHONUNBUFFERED": "1"}
