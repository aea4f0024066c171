"""What the system knows of a process (Linux: /proc); 0 for one that is gone."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path


def resident_mib(pid: int) -> float:
    """Resident memory without what it shares, MiB."""
    try:
        _, resident, shared = Path(f"/proc/{pid}/statm").read_text().split()[:3]
    except OSError:
        return 0.0
    return (int(resident) - int(shared)) * os.sysconf("SC_PAGE_SIZE") / (1 << 20)


def own_mib(pid: int) -> float:
    """Resident memory that is nobody else's, and of no file, MiB."""
    try:
        fields = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
        return int(fields["RssAnon"].split()[0]) / 1024.0
    except (OSError, KeyError):  # one that has ended and was not waited for has no memory
        return 0.0


def shared_memory_mib(pids: Iterable[int]) -> float:
    """What the host holds of shared memory (/dev/shm) that these processes have open, each piece once, MiB."""
    pieces: dict[int, int] = {}  # bytes, by the file's number
    for pid in pids:
        for at in _open_paths(pid):
            with suppress(OSError):  # closed meanwhile
                if os.readlink(at).startswith("/dev/shm/"):
                    status = os.stat(at)
                    pieces[status.st_ino] = 512 * status.st_blocks
    return sum(pieces.values()) / (1 << 20)


def cpu_s(pid: int) -> float:
    """CPU time since its start, s."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def open_files(pid: int) -> int:
    """File descriptors."""
    return len(_open_paths(pid))


def _open_paths(pid: int) -> list[str]:
    """Paths below /proc of the files that a process has open."""
    try:
        return [f"/proc/{pid}/fd/{name}" for name in os.listdir(f"/proc/{pid}/fd")]
    except OSError:
        return []
