"""A process of the supervisor's, its child or one taken over: listened to, stopped, and asked why it died."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
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


class WatchedProcess(ABC):
    """Its log lines go to ``on_line``; the last ones are kept to tell why it died."""

    def __init__(self, on_line: LineSink) -> None:
        self.started_s = time.monotonic()
        self._tail: deque[str] = deque(maxlen=TAIL_LINES)
        self._on_line = on_line
        self._readers: list[threading.Thread] = []

    @property
    @abstractmethod
    def pid(self) -> int:
        """Process id."""

    @abstractmethod
    def exit_code(self) -> int | None:
        """None while it runs; negative: the signal that ended it."""

    @abstractmethod
    def wait(self, timeout_s: float) -> bool:
        """Wait for its end; False if it still runs after ``timeout_s``."""

    @abstractmethod
    def close(self) -> None:
        """Free the files of a process that has ended."""

    @abstractmethod
    def _signal(self, number: signal.Signals) -> None:
        """Send a signal, unless it has ended."""

    def why(self) -> str:
        """How it ended, in words, with its last log lines."""
        if self.exit_code() is None:
            return "still running"
        self._join_readers()
        how = self._how()
        return f"{how}; last lines: " + " | ".join(self._tail) if self._tail else how

    def terminate(self) -> None:
        """Ask it to end (SIGTERM), even if it is stopped."""
        self._signal(signal.SIGTERM)
        self._signal(signal.SIGCONT)

    def kill(self) -> None:
        """End it."""
        self._signal(signal.SIGKILL)

    def _how(self) -> str:
        code = self.exit_code() or 0
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"

    def _read(self, pipe: IO[str], take: LineSink) -> None:
        def read() -> None:
            for line in pipe:
                take(line.rstrip())

        self._readers.append(threading.Thread(target=read, daemon=True))
        self._readers[-1].start()

    def _take_log_line(self, line: str) -> None:
        self._tail.append(line)
        self._on_line(line)

    def _join_readers(self) -> None:
        for reader in self._readers:
            reader.join(_LOG_READ_S)


class ChildProcess(WatchedProcess):
    """A process that is started here.

    It has a process group of its own, so that Ctrl-C in the terminal reaches the supervisor alone, which then stops
    its children in good order; not a session of its own, because schedulers may share out the time by sessions first,
    and then low priority means nothing between processes.
    """

    def __init__(self, command: Sequence[str], on_line: LineSink = to_stderr) -> None:
        super().__init__(on_line)
        self._said: set[str] = set()
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
        assert self._popen.stderr is not None and self._popen.stdout is not None
        self._read(self._popen.stderr, self._take_log_line)
        self._read(self._popen.stdout, self._said.add)

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

    def tell(self, order: dict[str, str]) -> bool:
        """Write one line of JSON to its stdin; False if it is gone."""
        assert self._popen.stdin is not None
        try:
            self._popen.stdin.write(json.dumps(order) + "\n")
            self._popen.stdin.flush()
        except OSError:
            return False
        return True

    def wait(self, timeout_s: float) -> bool:
        """Wait for its end; False if it still runs after ``timeout_s``."""
        try:
            self._popen.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> None:
        """Free the pipes of a process that has ended."""
        self._join_readers()
        for pipe in (self._popen.stdin, self._popen.stdout, self._popen.stderr):
            if pipe is not None:
                try:
                    pipe.close()
                except OSError:
                    continue  # an order that was never read; its reader is gone

    def _signal(self, number: signal.Signals) -> None:
        if self._popen.poll() is None:
            self._popen.send_signal(number)


class AdoptedProcess(WatchedProcess):
    """A process that another supervisor started (Linux); it stays ours as long as ``connection`` is open.

    ``process``: the file that tells of its end; ``log``: where its log lines come from.
    """

    def __init__(self, pid: int, process: int, connection: socket.socket, log: IO[str], on_line: LineSink) -> None:
        super().__init__(on_line)
        self._pid, self._process, self._connection, self._log = pid, process, connection, log
        self._ended = False
        self._read(log, self._take_log_line)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._pid

    def exit_code(self) -> int | None:
        """None while it runs; afterwards 0, as only its parent would be told the true one."""
        return 0 if self.wait(0.0) else None

    def wait(self, timeout_s: float) -> bool:
        """Wait for its end; False if it still runs after ``timeout_s``."""
        if not self._ended:
            end = select.poll()
            end.register(self._process, select.POLLIN)
            self._ended = bool(end.poll(1e3 * timeout_s))
        return self._ended

    def close(self) -> None:
        """Free the files of a process that has ended; one that has not is an orphan again."""
        self._connection.close()
        self._join_readers()
        self._log.close()
        os.close(self._process)

    def _how(self) -> str:
        return "ended, a process of another supervisor's before"

    def _signal(self, number: signal.Signals) -> None:
        if not self.wait(0.0):
            signal.pidfd_send_signal(self._process, number)


def stop_all(children: Sequence[WatchedProcess], patience_s: float = 3.0) -> None:
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
