"""Zenoh's pools of shared memory: whose they are, and giving back those of the dead.

Each process that sends large messages has a pool. Whoever receives one maps the whole pool and locks it into memory,
and Zenoh keeps that mapping for the life of the receiver: each death of a sender would leave 64 MiB with every
receiver. So a sender of velod puts a lock on its pool's file, which the kernel drops with the process, however that
ends; receivers look once a second, and empty those pools whose lock is gone. Pools that never were locked, of drivers
that are not velod's, are left alone: nobody can tell whether their owner lives. Linux only; elsewhere all stays.

Processes that take no large messages get one all the same, now and then: until a new link's two ends have told each
other what they want, Zenoh sends everything. They then map the sender's pool, have no use for it, and let go of it.
"""

from __future__ import annotations

import ctypes
import logging
import os
import re
import struct
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

log = logging.getLogger("velod")

POOL_BYTES: Final = 64 << 20
"""Of each process that sends large messages."""
SMALL_BYTES: Final = 4 << 20
"""Files below are Zenoh's own accounts (1.3 MiB a process), which are not ours to empty."""
GRACE_S: Final = 3.0
"""After its owner's death, until a pool is emptied: Zenoh's threads copy what comes in at once, in milliseconds."""
MAKING_S: Final = 0.5
"""Zenoh makes a pool besides, after the first large message; measured: 0.05 s."""
_POLL_S: Final = 0.005
_CLOCK_TICK_NS: Final = 20_000_000
"""A file's time may be so much older than the clock's."""

_FILES: Final = "/proc/self/fd"
_NAME: Final = re.compile(r"/dev/shm/\d+\.zenoh(?: \(deleted\))?")
_MAPPING: Final = re.compile(r"([0-9a-f]+)-([0-9a-f]+) \S+ [0-9a-f]+ \S+ (\d+)\s+/dev/shm/\d+\.zenoh")
_LOCK: Final = "hhqqi4x"  # struct flock, 64 bits
_PUNCH_HOLE_KEEP_SIZE: Final = 3
_DONT_NEED: Final = 4


@contextmanager
def owned(since_ns: int) -> Iterator[int]:
    """Own the pool that this process makes since ``since_ns`` (wall clock), as long as the context lasts; how many.

    Waits until it is made, where there is shared memory at all. A pool that another process locked is that one's,
    however new it is.
    """
    deadline_s = time.monotonic() + (MAKING_S if any(_zenoh_files()) else 0.0)
    locked: list[int] = []
    while not locked:
        locked = [file for file, _ in _open_pools(since_ns - _CLOCK_TICK_NS) if _try_lock(file)]
        if time.monotonic() > deadline_s:
            break
        time.sleep(_POLL_S)
    try:
        yield len(locked)
    finally:
        for file in locked:
            os.close(file)


class PoolKeeper:
    """Gives back the pools whose owners are gone. Call ``look`` about once a second.

    ``takes_large``: whether the process has a use for the pools of others.
    """

    def __init__(self, *, takes_large: bool = True) -> None:
        self._takes_large = takes_large
        self._seen_locked_s: dict[int, float] = {}  # by the file's number: when its owner was last alive

    def look(self, now_s: float) -> int:
        """Empty the pools whose owners have been gone for GRACE_S at ``now_s`` (monotonic); returns how many."""
        emptied, seen = 0, {}
        for file, number in _open_pools():
            try:
                if _is_locked(file):
                    seen[number] = now_s
                    if not self._takes_large:
                        _let_go(number)
                elif number in self._seen_locked_s:
                    if now_s - self._seen_locked_s[number] < GRACE_S:
                        seen[number] = self._seen_locked_s[number]
                    else:
                        _empty(file, number)
                        emptied += 1
            finally:
                os.close(file)
        self._seen_locked_s = seen
        return emptied


def _open_pools(since_ns: int = 0) -> Iterator[tuple[int, int]]:
    """Each pool that this process has open: a file of its own, to be closed, and the file's number."""
    for path in _zenoh_files():
        try:
            file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except OSError:
            continue  # closed a moment ago
        status = os.fstat(file)
        if status.st_size >= SMALL_BYTES and status.st_mtime_ns >= since_ns:
            yield file, status.st_ino
        else:
            os.close(file)


def _zenoh_files() -> Iterator[str]:
    """What this process has open of Zenoh's shared memory: paths below /proc."""
    if sys.platform != "linux":
        return
    for name in os.listdir(_FILES):
        with suppress(OSError):  # closed a moment ago
            if _NAME.fullmatch(os.readlink(f"{_FILES}/{name}")) is not None:
                yield f"{_FILES}/{name}"


if sys.platform == "linux":
    import fcntl

    def _try_lock(file: int) -> bool:
        """Lock a file for as long as it is open; if another has locked it, close it and return False."""
        try:
            fcntl.fcntl(file, fcntl.F_OFD_SETLK, struct.pack(_LOCK, fcntl.F_WRLCK, os.SEEK_SET, 0, 1, 0))
        except OSError:
            os.close(file)
            return False
        return True

    def _is_locked(file: int) -> bool:
        asked = struct.pack(_LOCK, fcntl.F_WRLCK, os.SEEK_SET, 0, 1, 0)
        answer = fcntl.fcntl(file, fcntl.F_OFD_GETLK, asked)
        return bool(struct.unpack(_LOCK, answer)[0] != fcntl.F_UNLCK)

else:

    def _try_lock(file: int) -> bool:
        raise NotImplementedError

    def _is_locked(file: int) -> bool:
        raise NotImplementedError


def _empty(file: int, number: int) -> None:
    """Free a pool's memory for all who map it: what is read there is zero now."""
    libc = _let_go(number)
    size = os.fstat(file).st_size
    if libc.fallocate(file, _PUNCH_HOLE_KEEP_SIZE, ctypes.c_int64(0), ctypes.c_int64(size)) == 0:
        log.info("%.0f MiB of shared memory given back: its owner is gone", size / (1 << 20))
    else:
        log.warning("shared memory of a process that is gone stays: %s", os.strerror(ctypes.get_errno()))


def _let_go(number: int) -> ctypes.CDLL:
    """Hold no page of a pool in this process any more; one that is read all the same comes back as it was."""
    libc = ctypes.CDLL(None, use_errno=True)
    for mapping in _MAPPING.finditer(Path("/proc/self/maps").read_text()):
        if int(mapping[3]) == number:
            start = int(mapping[1], 16)
            place = ctypes.c_void_p(start), ctypes.c_size_t(int(mapping[2], 16) - start)
            libc.munlock(*place)
            libc.madvise(*place, _DONT_NEED)
    return libc
