"""Values of a received message, each checked against its field of the schema."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from velod.wire.schema import INT64, OFFSET, Field, Schema, WireError, short

_BIN_TYPES = (bytes, memoryview)
_MAP_TYPES: dict[str, tuple[type, ...]] = {"int": (int,), "float": (int, float), "str": (str,)}


def sizes_of(s: Schema, tree: dict[str, Any]) -> dict[str, int]:
    """Every dim of a received message: scalars that were sent, and the rows of the longest column.

    Raises WireError.
    """
    sizes = {
        d.name: _read_int(s, _int_field(d.name, 0, INT64[1]), tree, {}) if d.sent else 0 for d in s.dims.values()
    }
    for f in s.fields:
        if f.counts_rows and (f.name in tree or not f.optional):
            rows = -(-len(_bin(s, f, tree)) // f.row_bytes)
            sizes[f.counts_rows] = max(sizes[f.counts_rows], rows)
    for dim in s.dims.values():
        if sizes[dim.name] > dim.max:
            raise WireError("wire.too_large", f"{s.name}: {dim.name} = {sizes[dim.name]}, the limit is {dim.max}")
    return sizes


def read(s: Schema, f: Field, tree: dict[str, Any], sizes: dict[str, int]) -> Any:
    """What was sent, or the default where the sender's velod did not know the field yet. Raises WireError.

    What it must have sent is missed on reading.
    """
    if not f.optional or f.name in tree:
        return _READ[f.kind](s, f, tree, sizes)
    return np.full(_shape(f, sizes), f.default, f.dtype) if f.kind == "column" else copy(f.default)


def check_column(s: Schema, f: Field, values: dict[str, Any]) -> None:
    """What a schema promises of a column's values. Raises WireError where it is not so."""
    a = values[f.name]
    if a.size == 0:
        return
    lo, hi = np.minimum.reduce(a, None), np.maximum.reduce(a, None)  # NaN where one is
    if (f.finite is True or (f.finite and values[f.finite])) and not (math.isfinite(lo) and math.isfinite(hi)):
        raise WireError("wire.not_finite", f"{s.name}: {f.name} holds NaN or inf")
    wrong = (
        (f.min is not None and lo < f.min)
        or (f.max is not None and hi > f.max)
        or (f.above is not None and not lo > f.above)
        or (f.below and hi >= values[f.below])
    )
    if wrong:
        raise WireError("wire.bounds", f"{s.name}: {f.name} holds {lo} .. {hi}")
    if f.order == "increasing" and not (a[1:] > a[:-1]).all():
        raise WireError("wire.time_backwards" if f.name.endswith("t_ns") else "wire.order", f"{s.name}: {f.name}")


def _bin(s: Schema, f: Field, tree: dict[str, Any]) -> bytes | memoryview:
    data = _get(s, f.sent_as, tree)
    if type(data) not in _BIN_TYPES:
        raise WireError("wire.field_type", f"{s.name}: {f.sent_as} must be bin, got {type(data).__name__}")
    return data  # type: ignore[no-any-return]


def _get(s: Schema, name: str, tree: dict[str, Any]) -> Any:
    try:
        return tree[name]
    except KeyError:
        raise WireError("wire.field_missing", f"{s.name}: {name}") from None


def _shape(f: Field, sizes: dict[str, int]) -> tuple[int, ...]:
    return f.fixed_shape or tuple(part if isinstance(part, int) else sizes[part] for part in f.shape)


def _read_int(s: Schema, f: Field, tree: dict[str, Any], sizes: dict[str, int]) -> int:
    value = tree.get(f.name)
    if type(value) is int and f.lowest <= value <= f.highest:
        return value
    value = _get(s, f.name, tree)
    if type(value) is not int:
        raise WireError("wire.field_type", f"{s.name}: {f.name} must be an integer, got {type(value).__name__}")
    raise WireError("wire.bounds", f"{s.name}: {f.name} = {value}, allowed {f.lowest} .. {f.highest}")


def _read_float(s: Schema, f: Field, tree: dict[str, Any], sizes: dict[str, int]) -> float:
    value = _get(s, f.name, tree)
    if type(value) not in (int, float):
        raise WireError("wire.field_type", f"{s.name}: {f.name} must be a number, got {type(value).__name__}")
    return float(value)


def _read_bool(s: Schema, f: Field, tree: dict[str, Any], sizes: dict[str, int]) -> bool:
    value = _get(s, f.name, tree)
    if type(value) is not bool:
        raise WireError("wire.field_type", f"{s.name}: {f.name} must be a boolean, got {type(value).__name__}")
    return value


def _read_str(s: Schema, f: Field, tree: dict[str, Any], sizes: dict[str, int]) -> str:
    value = _get(s, f.name, tree)
    if type(value) is not str:
        raise WireError("wire.field_type", f"{s.name}: {f.name} must be a string, got {type(value).__name__}")
    if f.choices and value not in f.choices:
        raise WireError("wire.bounds", f"{s.name}: {f.name} = {short(value)}, allowed {', '.join(f.choices)}")
    return value


def _read_map(s: Schema, f: Field, tree: dict[str, Any], sizes: dict[str, int]) -> dict[str, Any]:
    value = _get(s, f.name, tree)
    allowed = _MAP_TYPES[f.values]
    if type(value) is not dict or not all(type(k) is str and type(v) in allowed for k, v in value.items()):
        raise WireError("wire.field_type", f"{s.name}: {f.name} must be a map from string to {f.values}")
    return {k: float(v) for k, v in value.items()} if f.values == "float" else value


def _read_column(s: Schema, f: Field, tree: dict[str, Any], sizes: dict[str, int]) -> NDArray[Any]:
    assert f.dtype is not None
    data = _bin(s, f, tree)
    if f.counts_rows and len(f.shape) == 1:
        _check_length(s, f, len(data), sizes[f.counts_rows] * f.row_bytes)
        return np.frombuffer(data, f.dtype)
    shape = _shape(f, sizes)
    _check_length(s, f, len(data), math.prod(shape) * f.dtype.itemsize)
    return np.frombuffer(data, f.dtype).reshape(shape)


def _read_times(s: Schema, f: Field, tree: dict[str, Any], sizes: dict[str, int]) -> NDArray[np.int64]:
    # So that none of the times leaves the range.
    base = _read_int(s, _int_field(f.base, INT64[0], INT64[1] - 2**32), tree, sizes)
    data = _bin(s, f, tree)
    _check_length(s, f, len(data), sizes[f.counts_rows] * f.row_bytes)
    times = np.frombuffer(data, OFFSET).astype(np.int64)
    times += base
    return times


@cache
def _int_field(name: str, lo: int, hi: int) -> Field:
    """A number that is sent for a column's sake."""
    return Field(name, "int", lowest=lo, highest=hi)


def _check_length(s: Schema, f: Field, got: int, want: int) -> None:
    if got != want:
        reason = "wire.column_short" if got < want else "wire.column_long"
        raise WireError(reason, f"{s.name}: {f.sent_as} has {got} bytes, {want} belong there")


_READ: dict[str, Callable[[Schema, Field, dict[str, Any], dict[str, int]], Any]] = {
    "int": _read_int,
    "float": _read_float,
    "bool": _read_bool,
    "str": _read_str,
    "map": _read_map,
    "column": _read_column,
    "times": _read_times,
}
