"""Messages to bytes and back: a msgpack map whose arrays are columns of raw little-endian bytes.

What is sent and what is checked is said by the schemas (``velod.wire.schema``), not here. Whatever ``decode`` is
given, it returns a message that keeps its schema's promises or raises WireError.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import msgpack

from velod.types import Message
from velod.wire.reading import check_column, read, sizes_of
from velod.wire.schema import MAX_BYTES, MESSAGE_TYPES, VERSION, Field, Schema, WireError, schema, short
from velod.wire.unpack import unpack_views
from velod.wire.writing import WRITE, Writer

_MAX_STR = 1 << 16
_MAX_MAP = 1024
_WORTH_VIEWS = 16_384
"""Bytes; shorter messages are read faster by msgpack."""


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
    out = Writer(s, message.t_ns)
    out.put("t_pub_ns", t_pub_ns)
    out.put("t_origin_ns", t_origin_ns)
    for f in s.fields:
        WRITE[f.kind](f, getattr(message, f.name), out)
    for dim in s.dims.values():
        if out.sizes[dim.name] > dim.max:
            raise WireError("wire.too_large", f"{name}: {dim.name} = {out.sizes[dim.name]}, the limit is {dim.max}")
        if dim.sent:
            out.put(dim.name, out.sizes[dim.name])
    data = b"".join(out.pieces)
    if len(data) > MAX_BYTES:
        raise WireError("wire.too_large", f"{name}: {len(data)} bytes, the limit is {MAX_BYTES}")
    return data


def decode(
    data: bytes | bytearray | memoryview, expect: type[Any] | None = None, *, in_place: bool = False
) -> Envelope:
    """The message in ``data``; with ``expect``, only a message of that type. Raises WireError, and nothing else.

    Arrays are aligned, writable copies, so that a compiled kernel sees one kind of array wherever it comes from; with
    ``in_place``, for those who hand them to kernels as ``readonly``, views of ``data`` but for times.
    """
    tree = _unpack(data)
    s = _schema_of(tree, expect)
    sizes = sizes_of(s, tree)
    values = {f.name: read(s, f, tree, sizes) for f in s.fields}
    for f in s.fields:
        if f.kind == "column":
            if not in_place:
                # A view of the received bytes is read-only, which numba takes for another type of array.
                values[f.name] = values[f.name].astype(f.native)
            if f.promises:
                check_column(s, f, values)
        elif f.not_after and values[f.name] > values[f.not_after]:
            raise WireError("wire.time_backwards", f"{s.name}: {f.name} is after {f.not_after}")
    times = {f.name: read(s, f, tree, sizes) for f in _host_times()}
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
        raise WireError("wire.schema_unknown", f"schema {short(full)}")
    if type(tree.get("v")) is not int or tree["v"] != VERSION:
        raise WireError("wire.version_alien", f"{full}: version {short(tree.get('v'))}, this velod reads {VERSION}")
    if expect is not None and name != expect.__name__:
        raise WireError("wire.schema_unexpected", f"{full} where velod.{expect.__name__} belongs")
    return schema(name)
