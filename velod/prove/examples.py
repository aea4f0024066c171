"""One small, good message of each kind, made from its schema: what a fuzzer begins from."""

from __future__ import annotations

from typing import Any

import numpy as np

from velod.geometry.calibration import Calibration
from velod.runtime.warmup import plain_calibration
from velod.types import Message
from velod.wire.schema import MESSAGE_TYPES, Field, Schema, schema

_ROWS = 2


def example_messages() -> list[Message]:
    """In the order of their names."""
    return [example(name) for name in sorted(MESSAGE_TYPES)]


def example(name: str) -> Message:
    """A message that keeps all of its schema's promises."""
    s = schema(name)
    message: Message = MESSAGE_TYPES[name](**{f.name: _value(s, f) for f in s.fields})
    return message


def plain_rig() -> Calibration:
    """A plain pair of cameras."""
    return plain_calibration()


def _value(s: Schema, f: Field) -> Any:
    if f.kind in ("column", "times"):
        shape = tuple(part if isinstance(part, int) else _ROWS for part in f.shape)
        values = np.zeros(shape, np.int64 if f.dtype is None else f.dtype)
        if f.order:
            return np.arange(shape[0]).astype(values.dtype)
        return values + values.dtype.type(1 if f.above is not None else f.min or 0)
    if f.kind == "int":
        return max(f.min or 0, _ROWS)
    if f.kind == "str":
        return f.choices[0] if f.choices else "a"
    plain: dict[str, Any] = {"float": 1.0, "bool": True, "map": {}}
    return plain[f.kind]
