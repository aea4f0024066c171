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


def unpack_views(data: bytes | bytearray | memoryview) -> dict[str, Any] | None:
    """The map in ``data``, with a memoryview in place of each bin; None for anything but a whole map of short
    strings to plain values: that is for msgpack to read, or to refuse.
    """
    try:
        return _read_map(memoryview(data))
    except (IndexError, UnicodeDecodeError, error):
        return None


def _read_map(view: memoryview) -> dict[str, Any] | None:
    tree: dict[str, Any] = {}
    n, at = _map_header(view)
    for _ in range(n):
        if not 0xA0 <= (first := view[at]) <= 0xBF:
            return None
        name = str(view[at + 1 : (at := at + first - 0x9F)], "utf-8")
        first = view[at]
        at += 1
        if first < 0x80:
            tree[name] = first
        elif layout := _BINS.get(first):
            (length,) = layout.unpack_from(view, at)
            tree[name] = view[at + layout.size : (at := at + layout.size + length)]
        elif layout := _NUMBERS.get(first):
            (tree[name],) = layout.unpack_from(view, at)
            at += layout.size
        elif 0xA0 <= first <= 0xBF:
            tree[name] = str(view[at : (at := at + first - 0xA0)], "utf-8")
        elif first >= 0xE0:
            tree[name] = first - 0x100
        elif first in _CONSTANTS:
            tree[name] = _CONSTANTS[first]
        else:
            return None
    # A slice that reaches beyond the end is short, and then so is the whole.
    return tree if n and at == len(view) else None


def _map_header(view: memoryview) -> tuple[int, int]:
    """How many entries, and where they begin; no entries for what is no map of that many."""
    if 0x80 <= view[0] <= 0x8F:
        return view[0] - 0x80, 1
    return (view[1] << 8 | view[2], 3) if view[0] == 0xDE else (0, 0)
