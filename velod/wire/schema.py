"""The schemas of the wire: ``schemas/<message>.v1.json`` read once and turned into what the codec needs."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from typing import Any, get_args

import numpy as np

from velod import types

VERSION = 1
OFFSET = np.dtype("<u4")
"""Of the column that times are sent as."""
INT64 = (-(2**63), 2**63 - 1)
MAX_BYTES = 64 << 20
"""Largest message. A 1280x720 StereoBatch has 11 MB, a second of 5 Mev/s has 45 MB."""
MESSAGE_TYPES: dict[str, type[Any]] = {cls.__name__: cls for cls in get_args(types.Message)}


class WireError(ValueError):
    """Bytes that are not a usable message, or a message that cannot be sent.

    ``reason`` is a short name to count by, e.g. ``"wire.column_short"``; the text names message, field and cause.
    """

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(f"{reason}: {text}")
        self.reason = reason


def short(value: Any) -> str:
    """A value that somebody sent, for an error's text."""
    return repr(value)[:80]


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

    # What follows from the above, worked out once.
    sent_as: str = ""  # name of what is sent: of the scalar, or of the column
    counts_rows: str = ""  # name of the dim that the column's length says, if it does
    row_bytes: int = 0  # of one row of the column
    fixed_shape: tuple[int, ...] = ()  # of a column that always has the same
    native: np.dtype[Any] | None = None  # of a column, in this machine's byte order
    lowest: int = INT64[0]  # of an int
    highest: int = INT64[1]
    promises: bool = False  # whether a decoder has to look at a column's values


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
    dims = {name: Dim(name, d["sent"], d["max"]) for name, d in tree["dims"].items()}
    return Schema(
        name=tree["schema"],
        version=tree["version"],
        fields=tuple(_field(f, dims) for f in tree["fields"]),
        dims=dims,
    )


def _field(tree: dict[str, Any], dims: dict[str, Dim]) -> Field:
    known = {k: v for k, v in tree.items() if k not in ("unit", "frame", "doc")}
    for key in ("shape", "choices"):
        known[key] = tuple(known.get(key, ()))
    if "dtype" in known:
        known["dtype"] = np.dtype(known["dtype"])
    if "default" in known:
        known["optional"] = True
        if known["default"] is None:
            known["default"] = math.nan  # which JSON cannot say
    return _derived(Field(**known), dims)


def _derived(f: Field, dims: dict[str, Dim]) -> Field:
    """The field with what follows from it."""
    rows = f.shape[0] if f.shape else 0
    sizes = tuple(part for part in f.shape if isinstance(part, int))
    itemsize = OFFSET.itemsize if f.offsets else f.dtype.itemsize if f.dtype else 0
    return replace(
        f,
        sent_as=f.offsets or f.name,
        counts_rows=rows if isinstance(rows, str) and not dims[rows].sent else "",
        row_bytes=itemsize * math.prod(part for part in f.shape[1:] if isinstance(part, int)),
        fixed_shape=sizes if len(sizes) == len(f.shape) else (),
        native=f.dtype.newbyteorder("=") if f.dtype else None,
        lowest=INT64[0] if f.min is None else f.min,
        highest=INT64[1] if f.max is None else f.max,
        promises=any((f.finite, f.order, f.below)) or any(limit is not None for limit in (f.min, f.max, f.above)),
    )
