"""Messages to bytes and back: a msgpack map whose arrays are columns of raw little-endian bytes.

What is sent and what is checked is said by the schemas (``velod.wire.schema``), not here. Whatever ``decode`` is
given, it returns a message that keeps its schema's promises or raises WireError.
"""

from __future__ import annotations

import math
import operator
import struct
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from velod.types import Message
from velod.wire.schema import INT64, MESSAGE_TYPES, OFFSET, VERSION, Field, Schema, WireError, schema
from velod.wire.unpack import unpack_views

MAX_BYTES = 64 << 20
"""Largest message. A 1280x720 StereoBatch has 11 MB, a second of 5 Mev/s has 45 MB."""

_PACKER_BYTES = 4096
"""Room for one thing that is no column; the packer's buffer grows where it needs more."""
_MAX_STR = 1 << 16
_MAX_MAP = 1024
_TIMES = np.dtype("<i8")
_BIN_TYPES = (bytes, memoryview)
_WORTH_VIEWS = 16_384
"""Bytes; shorter messages are read faster by msgpack."""
_BIN_HEADERS = (
    (1 << 8, struct.Struct(">BB"), 0xC4),
    (1 << 16, struct.Struct(">BH"), 0xC5),
    (1 << 32, struct.Struct(">BI"), 0xC6),
)
"""msgpack's bin 8, 16 and 32: below which length, layout, first byte."""


@dataclass(frozen=True, slots=True)
class Envelope:
    """A decoded message with the two host times it travelled with (ns since 1970)."""

    message: Message
    t_pub_ns: int
    t_origin_ns: int  # when the batch that the message derives from was closed; 0: none


def encode(message: Message, t_pub_ns: int, t_origin_ns: int = 0) -> bytes:
    """The bytes of a message, as ``msgpack.packb`` would make them, with each column copied once: into its place.

    Raises WireError where it does not fit its schema (dtype, shape, span).
    """
    name = type(message).__name__
    s = schema(name)
    out = _Writer(s, message.t_ns)
    out.put("t_pub_ns", t_pub_ns)
    out.put("t_origin_ns", t_origin_ns)
    for f in s.fields:
        _WRITE[f.kind](f, getattr(message, f.name), out)
    for dim in s.dims.values():
        if out.sizes[dim.name] > dim.max:
            raise WireError("wire.too_large", f"{name}: {dim.name} = {out.sizes[dim.name]}, the limit is {dim.max}")
        if dim.sent:
            out.put(dim.name, out.sizes[dim.name])
    data = b"".join(out.pieces)
    if len(data) > MAX_BYTES:
        raise WireError("wire.too_large", f"{name}: {len(data)} bytes, the limit is {MAX_BYTES}")
    return data


class _Writer:
    """The pieces of one message, and the sizes of its columns so far."""

    __slots__ = ("_names", "_pack", "pieces", "s", "sizes", "t_ns")

    def __init__(self, s: Schema, t_ns: int) -> None:
        self.s, self.t_ns = s, t_ns
        self.sizes: dict[str, int] = {}
        self._pack = msgpack.Packer(buf_size=_PACKER_BYTES).pack
        head, self._names = _packed_names(s.name)
        self.pieces: list[bytes | memoryview] = [head]

    def put(self, name: str, value: Any) -> None:
        """A value that is no column."""
        self.pieces += (self._names[name], self._pack(value))

    def put_column(self, name: str, column: memoryview) -> None:
        self.pieces += (self._names[name], _bin_header(column.nbytes), column)


@cache
def _packed_names(full: str) -> tuple[bytes, dict[str, bytes]]:
    """How a message of a schema begins, and the names of what follows."""
    s = schema(full.removeprefix("velod."))
    names = ["t_pub_ns", "t_origin_ns", *(f.base for f in s.fields if f.base), *(f.sent_as for f in s.fields)]
    names += [dim.name for dim in s.dims.values() if dim.sent]
    packer = msgpack.Packer()
    first = {"schema": s.name, "v": VERSION}
    head = packer.pack_map_header(len(first) + len(names))
    for name, value in first.items():
        head += packer.pack(name) + packer.pack(value)
    return head, {name: packer.pack(name) for name in names}


def _bin_header(n_bytes: int) -> bytes:
    for limit, layout, first in _BIN_HEADERS:
        if n_bytes < limit:
            return layout.pack(first, n_bytes)
    raise WireError("wire.too_large", f"a column of {n_bytes} bytes, the limit is {MAX_BYTES}")


def decode(
    data: bytes | bytearray | memoryview, expect: type[Any] | None = None, *, in_place: bool = False
) -> Envelope:
    """The message in ``data``; with ``expect``, only a message of that type. Raises WireError, and nothing else.

    Arrays are aligned, writable copies, so that a compiled kernel sees one kind of array wherever it comes from; with
    ``in_place``, for those who hand them to kernels as ``readonly``, views of ``data`` but for times.
    """
    tree = _unpack(data)
    s = _schema_of(tree, expect)
    sizes = _sizes(s, tree)
    values = {f.name: _value(s, f, tree, sizes) for f in s.fields}
    for f in s.fields:
        if f.kind == "column":
            if not in_place:
                # A view of the received bytes is read-only, which numba takes for another type of array.
                values[f.name] = values[f.name].astype(f.native)
            if f.promises:
                _check_column(s, f, values)
        elif f.not_after and values[f.name] > values[f.not_after]:
            raise WireError("wire.time_backwards", f"{s.name}: {f.name} is after {f.not_after}")
    times = {f.name: _value(s, f, tree, sizes) for f in _host_times()}
    message = MESSAGE_TYPES[s.name.removeprefix("velod.")](**values)
    return Envelope(message=message, **times)


def peek(data: bytes, name: str) -> Any:
    """One value of a message, as it was sent and unchecked; None where there is none. Raises WireError for no map."""
    return _unpack(data).get(name)


@cache
def _host_times() -> tuple[Field, ...]:
    return tuple(f for f in schema("Envelope").fields if f.name.startswith("t_"))


def _unpack(data: bytes | bytearray | memoryview) -> dict[str, Any]:
    if len(data) > MAX_BYTES:
        raise WireError("wire.too_large", f"{len(data)} bytes, the limit is {MAX_BYTES}")
    if len(data) > _WORTH_VIEWS and not isinstance(data, memoryview) and (views := unpack_views(data)) is not None:
        return views
    try:
        tree = msgpack.unpackb(
            data, max_str_len=_MAX_STR, max_map_len=_MAX_MAP, max_bin_len=len(data), max_array_len=0, max_ext_len=0
        )
    except msgpack.ExtraData:
        raise WireError("wire.not_msgpack", "bytes after the end of the message") from None
    except (ValueError, TypeError, RecursionError) as e:
        # msgpack says "incomplete input" for a message that was cut off, and leaves everything else to the text.
        reason = "wire.truncated" if "incomplete input" in str(e) else "wire.not_msgpack"
        raise WireError(reason, f"{len(data)} bytes: {e}") from None
    if not isinstance(tree, dict):
        raise WireError("wire.not_map", f"a msgpack {type(tree).__name__} instead of a map")
    return tree


def _schema_of(tree: dict[str, Any], expect: type[Any] | None) -> Schema:
    full = tree.get("schema")
    name = full.removeprefix("velod.") if isinstance(full, str) else ""
    if name not in MESSAGE_TYPES or full != f"velod.{name}":
        raise WireError("wire.schema_unknown", f"schema {_short(full)}")
    if type(tree.get("v")) is not int or tree["v"] != VERSION:
        raise WireError("wire.version_alien", f"{full}: version {_short(tree.get('v'))}, this velod reads {VERSION}")
    if expect is not None and name != expect.__name__:
        raise WireError("wire.schema_unexpected", f"{full} where velod.{expect.__name__} belongs")
    return schema(name)


def _short(value: Any) -> str:
    return repr(value)[:80]


# --- sizes ---


def _sizes(s: Schema, tree: dict[str, Any]) -> dict[str, int]:
    """Every dim of a received message: scalars that were sent, and the rows of the longest column."""
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


# --- reading ---


def _value(s: Schema, f: Field, tree: dict[str, Any], sizes: dict[str, int]) -> Any:
    """What was sent, or the default where the sender's velod did not know the field yet; what it must have sent is
    missed on reading.
    """
    if not f.optional or f.name in tree:
        return _READ[f.kind](s, f, tree, sizes)
    return np.full(_shape(f, sizes), f.default, f.dtype) if f.kind == "column" else copy(f.default)


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
        raise WireError("wire.bounds", f"{s.name}: {f.name} = {_short(value)}, allowed {', '.join(f.choices)}")
    return value


_MAP_TYPES: dict[str, tuple[type, ...]] = {"int": (int,), "float": (int, float), "str": (str,)}


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


def _check_column(s: Schema, f: Field, values: dict[str, Any]) -> None:
    """What a schema promises of a column's values."""
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


_READ: dict[str, Callable[[Schema, Field, dict[str, Any], dict[str, int]], Any]] = {
    "int": _read_int,
    "float": _read_float,
    "bool": _read_bool,
    "str": _read_str,
    "map": _read_map,
    "column": _read_column,
    "times": _read_times,
}


# --- writing ---

_PLAIN: dict[str, Callable[[Any], Any]] = {"int": operator.index, "float": float, "bool": bool, "str": str}


def _write_plain(f: Field, value: Any, out: _Writer) -> None:
    """A scalar; numpy's scalars become Python's."""
    try:
        out.put(f.name, _PLAIN[f.kind](value))
    except TypeError:
        raise WireError("wire.field_type", f"{out.s.name}: {f.name} = {_short(value)}") from None


def _write_map(f: Field, value: Any, out: _Writer) -> None:
    plain = _PLAIN[f.values]
    out.put(f.name, {str(k): plain(v) for k, v in value.items()})


def _write_column(f: Field, value: Any, out: _Writer) -> None:
    assert f.dtype is not None
    _check_array(f, value, f.dtype, out)
    out.put_column(f.name, np.ascontiguousarray(value, f.dtype).data)


def _write_times(f: Field, value: Any, out: _Writer) -> None:
    _check_array(f, value, _TIMES, out)
    base, last = (int(value.min()), int(value.max())) if value.size else (int(out.t_ns),) * 2
    if last - base > 2**32 - 1:
        span_s = (last - base) * 1e-9
        raise WireError(
            "wire.span", f"{out.s.name}: {f.name} spans {span_s:.3f} s, at most 4.294 s fit; split the packet"
        )
    out.put(f.base, base)
    # Modulo 2^32, which is the difference itself, as it fits.
    offsets = value.astype(OFFSET, order="C")
    offsets -= OFFSET.type(base % 2**32)
    out.put_column(f.offsets, offsets.data)


def _check_array(f: Field, value: Any, dtype: np.dtype[Any], out: _Writer) -> None:
    if type(value) is not np.ndarray or value.dtype != dtype:
        got = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise WireError("wire.dtype", f"{out.s.name}: {f.name} must be an array of {dtype}, got {got}")
    fits = value.ndim == len(f.shape)
    for part, got in zip(f.shape, value.shape, strict=False):
        fits &= got == (part if isinstance(part, int) else out.sizes.setdefault(part, got))
    if not fits:
        raise WireError("wire.shape", f"{out.s.name}: {f.name} must be {list(f.shape)}, got {value.shape}")


_WRITE: dict[str, Callable[[Field, Any, _Writer], None]] = {
    "int": _write_plain,
    "float": _write_plain,
    "bool": _write_plain,
    "str": _write_plain,
    "map": _write_map,
    "column": _write_column,
    "times": _write_times,
}
