"""How a command ends."""

from __future__ import annotations

import signal
from threading import Event
from types import FrameType

EXIT_FAILED = 1  # the run went wrong, or its result is not good enough
EXIT_USAGE = 2  # the user can put it right: a file, a setting, a port

_interrupted = Event()


class RunFailed(Exception):
    """A run that went wrong through no fault of the command line; one line that says what and why."""


def interrupt_on_signals() -> None:
    """From now on SIGTERM ends a command as Ctrl-C does, by KeyboardInterrupt: half a file is not left behind."""
    _interrupted.clear()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)


def raise_if_interrupted() -> None:
    """For long work to call: Python drops exceptions of destructors and of weak references' callbacks.

    numba's arrays have many of those, and a KeyboardInterrupt may come up there.
    """
    if _interrupted.is_set():
        raise KeyboardInterrupt


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    _interrupted.set()
    raise KeyboardInterrupt
