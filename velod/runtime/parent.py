"""A process that dies with its parent, from its first moment on: imports nothing but the standard library."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def die_with(parent: int) -> None:
    """Have the kernel kill this process when ``parent`` is gone (Linux); 0: none. Raises OSError if it is already."""
    if parent and sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            raise OSError(f"the supervisor (process {parent}) is gone")


def outlive() -> None:
    """Take ``die_with`` back (Linux): the parent's end wakes this process if it is stopped, and nothing else."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGCONT)
