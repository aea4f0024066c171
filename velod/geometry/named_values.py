"""Values out of a calibration's tree of named values; errors name the file, the field and the reason (``where``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from velod.types import F64


class CalibrationError(ValueError):
    """A calibration that cannot be used; the text names the file, the field and the reason."""


def refuse_unknown(tree: Any, known: Sequence[str], where: str) -> None:
    """Raise CalibrationError where ``tree`` is no map, or holds a name that is not ``known``."""
    if not isinstance(tree, dict):
        raise CalibrationError(f"{where}: must hold named values, got {tree!r}")
    for key in tree:
        if key not in known:
            raise CalibrationError(f"{where}: {key}: unknown; known: {', '.join(known)}")


def get(tree: Any, key: str, where: str) -> Any:
    """The value of a name. Raises CalibrationError."""
    if not isinstance(tree, dict):
        raise CalibrationError(f"{where}: must hold named values, got {tree!r}")
    if key not in tree:
        raise CalibrationError(f"{where}: {key}: missing")
    return tree[key]


def number(value: Any, where: str) -> float:
    """A finite number. Raises CalibrationError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise CalibrationError(f"{where}: must be a finite number, got {value!r}")
    return float(value)


def integer(value: Any, where: str) -> int:
    """A whole number. Raises CalibrationError."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise CalibrationError(f"{where}: must be an integer, got {value!r}")
    return value


def array(value: Any, shape: tuple[int, ...], where: str) -> F64:
    """An array of that shape, of finite numbers. Raises CalibrationError."""
    try:
        a = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise CalibrationError(f"{where}: must be {'x'.join(map(str, shape))} numbers") from None
    if a.shape != shape:
        got = "x".join(map(str, a.shape))
        raise CalibrationError(f"{where}: must be {'x'.join(map(str, shape))} numbers, got {got}")
    if not np.isfinite(a).all():
        raise CalibrationError(f"{where}: must be finite numbers")
    return a
