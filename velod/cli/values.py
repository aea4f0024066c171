"""What is typed behind an option: numbers, names, files to write. What cannot be is refused before any work."""

from __future__ import annotations

import argparse
import errno
import math
import os
import re
from pathlib import Path


def speed(text: str) -> float:
    """Times real time; infinity for ``max``."""
    return math.inf if text == "max" else positive(text)


def positive(text: str) -> float:
    """A number above zero and finite, such as a time span."""
    value = _number(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be positive and finite, got {text}")
    return value


def not_negative(text: str) -> float:
    """A number from zero on, and finite."""
    value = _number(text)
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"must be zero or more and finite, got {text}")
    return value


def count(text: str) -> int:
    """A whole number from 1 on."""
    return _whole(text, 1, None)


def seed(text: str) -> int:
    """A whole number from 0 on."""
    return _whole(text, 0, None)


def port(text: str) -> int:
    """A TCP port."""
    return _whole(text, 1, 65535)


def rig_name(text: str) -> str:
    """One part of a key, and the name of a folder."""
    if not re.fullmatch(r"[^/*$?#\s.][^/*$?#\s]*", text):
        raise argparse.ArgumentTypeError(f"must be one part of a key, without / * $ ? # or blanks, got {text!r}")
    return text


def host(text: str) -> str:
    """Name or address of a host."""
    if not re.fullmatch(r"[\w.:-]+", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"must be the name or address of a host, got {text!r}")
    return text


def require_writable(*paths: str | None) -> None:
    """Raise OSError where a file cannot be made, before the work whose result it is to hold; None and ``-`` pass."""
    for path in paths:
        if path is None or path == "-":
            continue
        folder = Path(path).absolute().parent
        if Path(path).is_dir():
            raise OSError(errno.EISDIR, os.strerror(errno.EISDIR), path)
        if not folder.is_dir():
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT), path)
        if not os.access(path if Path(path).exists() else folder, os.W_OK):
            raise OSError(errno.EACCES, os.strerror(errno.EACCES), path)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"not a number: {text!r}") from None


def _whole(text: str, least: int, most: int | None) -> int:
    if not text.isdecimal() or int(text) < least or (most is not None and int(text) > most):
        within = f"from {least} on" if most is None else f"from {least} to {most}"
        raise argparse.ArgumentTypeError(f"must be a whole number {within}, got {text!r}")
    return int(text)
