"""The schemas of the wire: ``schemas/<message>.v1.json`` read once and turned into what the codec needs."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any, get_args

import numpy as np

from velod import types

VERSION = 1
MESSAGE_TYPES: dict[str, type[Any]] = {cls.__name__: cls for cls in get_args(types.Message)}


class WireError(ValueError):
    """Bytes that are not a usable message, or a message that cannot be sent.

    ``reason`` is a short name to count by, e.g. ``"wire.column_short"``; the text names message, field and cause.
    """

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(f"{reason}: {text}")
        self.reason = reason


@dataclass(frozen=True, slots=True)
class Dim:
    """A size that shapes refer to. ``sent``: a scalar of the message; otherwise the length of the columns."""

    name: str
    sent: bool
    max: int


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message: how it is sent and what a decoder checks."""

    name: str
    kind: str  # "int" | "float" | "bool" | "str" | "map" | "column" | "times"
    dtype: np.dtype[Any] | None = None  # of a column
    shape: tuple[int | str, ...] = ()  # numbers, or names of dims
    values: str = ""  # of a map: "int" | "float" | "str"
    base: str = ""  # of times: the scalar ...
    offsets: str = ""  # ... and the column of u32 that is added to it
    choices: tuple[str, ...] = ()
    min: int | None = None
    max: int | None = None
    above: float | None = None
    below: str = ""  # name of the int field that every value stays below
    not_after: str = ""  # name of the int field that the value does not exceed
    order: str = ""  # "increasing"
    finite: bool | str = False  # True, or the name of the bool field that demands it
    optional: bool = False  # came after the first messages of this version: may be missing ...
    default: Any = None  # ... and is then this; of every element of a column


@dataclass(frozen=True, slots=True)
class Schema:
    """One version of one message."""

    name: str  # "velod.EventPacket"
    version: int
    fields: tuple[Field, ...]
    dims: dict[str, Dim] = field(default_factory=dict)


@cache
def schema(message: str) -> Schema:
    """The schema of a message, e.g. ``schema("EventPacket")``."""
    tree = json.loads(files("velod.schemas").joinpath(f"{message}.v{VERSION}.json").read_text("utf-8"))
    return Schema(
        name=tree["schema"],
        version=tree["version"],
        fields=tuple(_field(f) for f in tree["fields"]),
        dims={name: Dim(name, d["sent"], d["max"]) for name, d in tree["dims"].items()},
    )


def _field(tree: dict[str, Any]) -> Field:
    known = {k: v for k, v in tree.items() if k not in ("unit", "frame", "doc")}
    for key in ("shape", "choices"):
        known[key] = tuple(known.get(key, ()))
    if "dtype" in known:
        known["dtype"] = np.dtype(known["dtype"])
    if "default" in known:
        known["optional"] = True
        if known["default"] is None:
            known["default"] = math.nan  # which JSON cannot say
    return Field(**known)
