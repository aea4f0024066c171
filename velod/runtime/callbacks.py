"""Python functions that the network's own threads call."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from typing import Any

import zenoh

_thread = threading.local()


def direct(function: Callable[[Any], None]) -> zenoh.handlers.Callback[Any]:
    """A handler that calls ``function`` in the network's thread; "indirect" hands each thing to one more thread."""

    def called(thing: Any) -> None:
        _keep_state()
        function(thing)

    return zenoh.handlers.Callback(called, indirect=False)


def _keep_state() -> None:
    """Have this thread keep the interpreter's record of it until it ends.

    A thread that is not Python's own gets one with each call and loses it afterwards: memory that is mapped, written
    to and unmapped again for each message. One more claim to it, which is never given back, leaves it there.
    """
    if not hasattr(_thread, "keeps"):
        _thread.keeps = True
        ctypes.pythonapi.PyGILState_Ensure()
