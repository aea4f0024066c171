"""What a supervisor does about workers that one before it has left behind at work (``custody``)."""

from __future__ import annotations

import logging
import os
import select
import signal
import socket
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Final

from velod.runtime.custody import ANSWER_S, YES, Place, peer_of
from velod.runtime.process import AdoptedProcess, LineSink

log = logging.getLogger("velod.supervisor")

_LISTENING: Final = "00010000"
"""A socket's flags in /proc/net/unix."""


def adopt(place: Place, wanted: Collection[str], who: bytes, on_line: LineSink) -> dict[str, AdoptedProcess]:
    """Take over those of the workers ``wanted`` that are at work already, by name; their log lines go to ``on_line``.

    All others of the service are ended: those that nobody wants, that work with something else than ``who``
    (``custody.identity``), or that do not answer. Returns when these are gone.
    """
    adopted = {}
    for worker in _left_behind(place):
        process = _take(place.address(worker), who if worker in wanted else b"", on_line)
        if process is not None:
            adopted[worker] = process
    return adopted


def _left_behind(place: Place) -> list[str]:
    """Workers of the service whose sockets there are."""
    if sys.platform != "linux":
        return []
    rows = [line.split() for line in Path("/proc/net/unix").read_text().splitlines()]
    names = [row[7].removeprefix("@") for row in rows if len(row) > 7 and row[3] == _LISTENING]
    return sorted(name.removeprefix(place.prefix) for name in names if name.startswith(place.prefix))


def _take(address: str, who: bytes, on_line: LineSink) -> AdoptedProcess | None:
    """The worker that listens there, if it works with ``who``; None where it did not and was ended, or is gone."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(ANSWER_S)
    try:
        connection.connect(address)
        pid, uid = peer_of(connection)
        if uid != os.getuid():
            connection.close()  # of another user, who took the name
            return None
        process = os.pidfd_open(pid)
    except OSError:  # ended a moment ago
        connection.close()
        return None
    lines, theirs = os.pipe()
    agreed = bool(who) and _agrees(connection, who, theirs)
    os.close(theirs)
    if agreed:
        return AdoptedProcess(pid, process, connection, os.fdopen(lines, errors="replace"), on_line)
    log.warning("process %d, left at work by another supervisor, is none for this one: ended", pid)
    _end(process)
    os.close(lines)
    connection.close()
    return None


def _agrees(connection: socket.socket, who: bytes, log_file: int) -> bool:
    """Whether the worker takes us for its supervisor; its log lines go to ``log_file`` then."""
    try:
        socket.send_fds(connection, [who], [log_file])
        return connection.recv(len(YES)) == YES
    except OSError:  # it hangs, or has ended
        return False


def _end(process: int) -> None:
    signal.pidfd_send_signal(process, signal.SIGKILL)
    gone = select.poll()
    gone.register(process, select.POLLIN)
    gone.poll(1e3 * ANSWER_S)
    os.close(process)
