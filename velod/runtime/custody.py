"""Workers that outlive a supervisor that was killed, until the next one takes them over (``adoption``). Linux only.

A worker at work listens on a Unix socket of the abstract namespace, named after the user, the service and the worker:
the kernel drops the name with the process, and lets no second process have it. When its supervisor is gone it works
on; for a while whoever connects, is of the same user and serves the same settings is its supervisor, as long as that
connection lasts. If nobody comes it ends, and where it cannot any more the kernel's alarm ends it.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import select
import signal
import socket
import struct
import sys
import time
from dataclasses import dataclass
from threading import Event, Thread
from typing import Final

from velod import config
from velod.config import Settings
from velod.geometry.calibration import Calibration
from velod.runtime.health import velod_version
from velod.runtime.parent import outlive

log = logging.getLogger("velod")

OUTLIVE_S: Final = 10.0
"""So long a worker of ``velod run`` waits for the next supervisor: systemd's half second and a start, busy cores."""
ANSWER_S: Final = 1.0
"""Whoever does not answer the other side for so long hangs."""
YES, NO = b"yes", b"no"
_LAST_WORDS_S: Final = 3
"""Until the alarm, for one that was to end by itself."""
_CREDENTIALS: Final = struct.Struct("3i")


@dataclass(frozen=True, slots=True)
class Place:
    """Where the workers of one service are found on this host: by its introducer's endpoint, and its rig."""

    endpoint: str
    rig: str

    @property
    def prefix(self) -> str:
        """Of the names of all of its workers' sockets."""
        service = hashlib.sha256(f"{self.endpoint} {self.rig}".encode()).hexdigest()[:16]
        return f"velod-{os.getuid()}-{service}-"

    def address(self, worker: str) -> str:
        """Of one worker's socket."""
        return f"\0{self.prefix}{worker}"


def identity(settings: Settings, calibration: Calibration) -> bytes:
    """Of what a worker works with: settings, calibration, velod's version; where two are equal they do the same."""
    trees = [config.to_tree(settings), calibration.to_tree(), velod_version()]
    return hashlib.sha256(json.dumps(trees, sort_keys=True).encode()).hexdigest().encode()


def peer_of(connection: socket.socket) -> tuple[int, int]:
    """Process and user at the other end."""
    pid, uid, _ = _CREDENTIALS.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return pid, uid


def live_in_custody(place: Place, worker: str, parent: int, wait_s: float, who: bytes, stop: Event) -> None:
    """Be ``worker`` from now on, and outlive ``parent`` by ``wait_s``, or until the end of another supervisor.

    ``stop`` is set when nobody has come. Does nothing where ``wait_s`` is 0, and elsewhere than on Linux. Raises
    OSError where another process is this worker already.
    """
    if not wait_s or sys.platform != "linux":
        return
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)  # open, and the name taken, while the process lives
    try:
        listener.bind(place.address(worker))
    except OSError:
        listener.close()
        raise OSError(f"another process is {worker} of this service already") from None
    listener.listen()
    outlive()
    ward = _Ward(listener, os.pidfd_open(parent), wait_s, who, stop)
    Thread(target=ward.watch, name="custody", daemon=True).start()


class _Ward:
    """A worker's thread that looks after whose the worker is."""

    def __init__(self, listener: socket.socket, parent: int, wait_s: float, who: bytes, stop: Event) -> None:
        """``parent``: the file of a process that can be read when it has ended."""
        self._listener, self._wait_s, self._who, self._stop = listener, wait_s, who, stop
        self._guardian: int | None = parent  # a file that can be read when the supervisor is gone
        self._end_s = 0.0

    def watch(self) -> None:
        """Until the worker is to end."""
        while self._guardian is not None or time.monotonic() < self._end_s:
            poll = select.poll()
            poll.register(self._listener, select.POLLIN)
            if self._guardian is not None:
                poll.register(self._guardian, select.POLLIN)
            wait_ms = None if self._guardian is not None else 1e3 * max(0.0, self._end_s - time.monotonic())
            ready = {file for file, _ in poll.poll(wait_ms)}
            if self._guardian in ready:
                self._lose_guardian()
            if self._listener.fileno() in ready:
                self._meet()
        self._stop.set()

    def _lose_guardian(self) -> None:
        assert self._guardian is not None
        os.close(self._guardian)
        self._guardian, self._end_s = None, time.monotonic() + self._wait_s
        signal.alarm(round(self._wait_s) + _LAST_WORDS_S)
        # Nobody reads what is written there, and to write would be an error.
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stderr.fileno())

    def _meet(self) -> None:
        """Somebody connects: a supervisor, or not."""
        connection, _ = self._listener.accept()
        with connection:
            connection.settimeout(ANSWER_S)
            try:
                is_ours = self._is_ours(connection)
                connection.sendall(YES if is_ours else NO)
            except OSError:
                return  # gone again
            if not is_ours:
                return
            signal.alarm(0)
            self._guardian = os.dup(connection.fileno())
        log.info("up, with another supervisor")

    def _is_ours(self, connection: socket.socket) -> bool:
        """Whether somebody is to be the supervisor; log lines then go to the file that comes along."""
        if self._guardian is not None or peer_of(connection)[1] != os.getuid():
            return False
        asked, files, _, _ = socket.recv_fds(connection, len(self._who) + 1, 1)
        is_ours = asked == self._who and len(files) == 1
        if is_ours:
            os.dup2(files[0], sys.stderr.fileno())
        for file in files:
            os.close(file)
        return is_ours
