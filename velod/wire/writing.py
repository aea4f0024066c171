"""A message in pieces: its values, each checked against its field of the schema, as msgpack writes them."""

from __future__ import annotations

import operator
import struct
from collections.abc import Callable
from functools import cache
from typing import Any

import msgpack
import numpy as np

from velod.wire.schema import MAX_BYTES, OFFSET, VERSION, Field, Schema, WireError, schema, short

_PACKER_BYTES = 4096
"""Room for one thing that is no column; the packer's buffer grows where it needs more."""
_TIMES = np.dtype("<i8")
_BIN_HEADERS = (
    (1 << 8, struct.Struct(">BB"), 0xC4),
    (1 << 16, struct.Struct(">BH"), 0xC5),
    (1 << 32, struct.Struct(">BI"), 0xC6),
)
"""msgpack's bin 8, 16 and 32: below which length, layout, first byte."""
_PLAIN: dict[str, Callable[[Any], Any]] = {"int": operator.index, "float": float, "bool": bool, "str": str}


class Writer:
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
        """A column, which is not copied here."""
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


def _write_plain(f: Field, value: Any, out: Writer) -> None:
    """A scalar; numpy's scalars become Python's."""
    try:
        out.put(f.name, _PLAIN[f.kind](value))
    except TypeError:
        raise WireError("wire.field_type", f"{out.s.name}: {f.name} = {short(value)}") from None


def _write_map(f: Field, value: Any, out: Writer) -> None:
    plain = _PLAIN[f.values]
    out.put(f.name, {str(k): plain(v) for k, v in value.items()})


def _write_column(f: Field, value: Any, out: Writer) -> None:
    assert f.dtype is not None
    _check_array(f, value, f.dtype, out)
    out.put_column(f.name, np.ascontiguousarray(value, f.dtype).data)


def _write_times(f: Field, value: Any, out: Writer) -> None:
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


def _check_array(f: Field, value: Any, dtype: np.dtype[Any], out: Writer) -> None:
    if type(value) is not np.ndarray or value.dtype != dtype:
        got = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise WireError("wire.dtype", f"{out.s.name}: {f.name} must be an array of {dtype}, got {got}")
    fits = value.ndim == len(f.shape)
    for part, got in zip(f.shape, value.shape, strict=False):
        fits &= got == (part if isinstance(part, int) else out.sizes.setdefault(part, got))
    if not fits:
        raise WireError("wire.shape", f"{out.s.name}: {f.name} must be {list(f.shape)}, got {value.shape}")


WRITE: dict[str, Callable[[Field, Any, Writer], None]] = {
    "int": _write_plain,
    "float": _write_plain,
    "bool": _write_plain,
    "str": _write_plain,
    "map": _write_map,
    "column": _write_column,
    "times": _write_times,
}
"""By the kind of a field."""
