"""What the C library does with memory that was freed (glibc; elsewhere nothing here has an effect)."""

from __future__ import annotations

import ctypes
import sys
from functools import cache
from typing import Any, Final

KEPT: Final = "memory.kept_mib"
"""Among the gauges of a process's health: resident, but free for what comes next."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_KEPT_BYTES: Final = 32 << 20
"""The largest that glibc takes for blocks that are not mapped one by one."""


class _MallInfo2(ctypes.Structure):
    """``struct mallinfo2``: sums over all arenas, bytes."""

    _NAMES = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost"
    _fields_ = tuple((name, ctypes.c_size_t) for name in _NAMES.split())


def keep_memory() -> None:
    """Have the C library keep what is freed: it comes back as fast as it went.

    Given back to the kernel, the memory of each large message would be mapped anew page by page: 0.3 ms for 405 KB.
    """
    if (libc := _libc()) is not None:
        libc.mallopt(_M_MMAP_THRESHOLD, _KEPT_BYTES)
        libc.mallopt(_M_TRIM_THRESHOLD, 4 * _KEPT_BYTES)


def heap_gauges() -> dict[str, float]:
    """``KEPT``; empty where the C library does not tell."""
    libc = _libc()
    if libc is None or not hasattr(libc, "mallinfo2"):  # glibc 2.33
        return {}
    libc.mallinfo2.restype = _MallInfo2
    return {KEPT: libc.mallinfo2().fordblks / (1 << 20)}


@cache
def _libc() -> Any:
    libc = ctypes.CDLL(None) if sys.platform == "linux" else None
    return libc if hasattr(libc, "mallopt") else None
