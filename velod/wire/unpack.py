"""A msgpack map whose columns stay where they lie: views of the message instead of copies.

msgpack itself copies every bin. In a message of 405 KB that is the larger part of reading it.
"""

from __future__ import annotations

from struct import Struct, error
from typing import Any

_BINS = {0xC4: Struct(">B"), 0xC5: Struct(">H"), 0xC6: Struct(">I")}
"""First byte: layout of the length that follows."""
_NUMBERS = {
    0xCA: Struct(">f"),
    0xCB: Struct(">d"),
    0xCC: Struct(">B"),
    0xCD: Struct(">H"),
    0xCE: Struct(">I"),
    0xCF: Struct(">Q"),
    0xD0: Struct(">b"),
    0xD1: Struct(">h"),
    0xD2: Struct(">i"),
    0xD3: Struct(">q"),
}
_CONSTANTS = {0xC2: False, 0xC3: True}


def unpack_views(data: bytes | bytearray) -> dict[str, Any] | None:
    """The map in ``data``, with a memoryview in place of each bin; None for anything but a whole map of short
    strings to plain values: that is for msgpack to read, or to refuse.
    """
    try:
        return _read_map(data)
    except (IndexError, UnicodeDecodeError, error):
        return None


def _read_map(data: bytes | bytearray) -> dict[str, Any] | None:
    tree: dict[str, Any] = {}
    view = memoryview(data)
    n, at = _map_header(data)
    for _ in range(n):
        if not 0xA0 <= (first := data[at]) <= 0xBF:
            return None
        name = data[at + 1 : (at := at + first - 0x9F)].decode()
        first = data[at]
        at += 1
        if first < 0x80:
            tree[name] = first
        elif layout := _BINS.get(first):
            (length,) = layout.unpack_from(data, at)
            tree[name] = view[at + layout.size : (at := at + layout.size + length)]
        elif layout := _NUMBERS.get(first):
            (tree[name],) = layout.unpack_from(data, at)
            at += layout.size
        elif 0xA0 <= first <= 0xBF:
            tree[name] = data[at : (at := at + first - 0xA0)].decode()
        elif first >= 0xE0:
            tree[name] = first - 0x100
        elif first in _CONSTANTS:
            tree[name] = _CONSTANTS[first]
        else:
            return None
    # A slice that reaches beyond the end is short, and then so is the whole.
    return tree if n and at == len(data) else None


def _map_header(data: bytes | bytearray) -> tuple[int, int]:
    """How many entries, and where they begin; no entries for what is no map of that many."""
    if 0x80 <= data[0] <= 0x8F:
        return data[0] - 0x80, 1
    return (data[1] << 8 | data[2], 3) if data[0] == 0xDE else (0, 0)
