"""The sensor of ``velod demo``: a recording of a simulated sequence, kept for the next time.

What publishes it is ``velod.runtime.player``, a process of its own, in real time and on the sensor topics: to velod
it is a camera. docs/driver.md says how to write a driver for a real one.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from velod.io.model import RecordingError
from velod.io.recording import open_recording
from velod.sim.run import Progress, simulate
from velod.sim.sequences import sequence

MODEL_VERSION = 5
"""Raised with every change of the simulator that changes what it records."""


def simulated_recording(
    name: str, seconds: float, seed: int, progress: Progress | None = None, texture_seed: int | None = None
) -> Path:
    """Path of a recording of the sequence ``name``, simulated unless an equal one was before.

    Kept (3 bytes an event) in ``$VELOD_CACHE_DIR``, ``$XDG_CACHE_HOME/velod`` or ``~/.cache/velod``.
    Raises SequenceError, RecordingError.
    """
    recipe = sequence(name, texture_seed)
    digest = hashlib.sha256()
    _feed(digest, (MODEL_VERSION, recipe, float(seconds), seed))
    path = cache_directory() / f"{name}-{digest.hexdigest()[:16]}.h5"
    try:
        open_recording(path)
    except RecordingError:  # missing, or cut short by a crash
        simulate(recipe, seconds, seed, path, progress)
    return path


def cache_directory() -> Path:
    """Where simulated recordings are kept; a temporary directory where the usual place cannot be written."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    wanted = Path(os.environ.get("VELOD_CACHE_DIR") or Path(base) / "velod") / "sim"
    try:
        wanted.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=wanted):
            return wanted
    except OSError:
        elsewhere = Path(tempfile.gettempdir()) / f"velod-{os.getuid()}" / "sim"
        elsewhere.mkdir(parents=True, exist_ok=True)
        return elsewhere


def _feed(digest: Any, value: Any) -> None:
    """Everything that a recipe says, in a fixed order."""
    if is_dataclass(value):
        for field in fields(value):
            digest.update(field.name.encode())
            _feed(digest, getattr(value, field.name))
    elif isinstance(value, tuple):
        for part in value:
            _feed(digest, part)
    elif isinstance(value, np.ndarray):
        digest.update(repr((value.shape, value.dtype.str)).encode() + value.tobytes())
    else:
        digest.update(repr(value).encode() + b";")
