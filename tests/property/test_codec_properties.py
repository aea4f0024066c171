"""Whatever can be sent comes back equal, and no bytes at all make the decoder raise anything but WireError."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import msgpack
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from velod.types import EventPacket, Message
from velod.wire import WireError, decode, encode
from velod.wire.schema import MESSAGE_TYPES, Field, Schema, schema
from velod.wire.unpack import unpack_views

I64 = st.integers(-(2**62), 2**62)
TEXT = st.text("aZ0.-é", max_size=12)
MAP_VALUES = {"int": I64, "float": st.floats(allow_nan=False), "str": TEXT}


def columns(f: Field, sizes: dict[str, int]) -> st.SearchStrategy[Any]:
    """Arrays that keep what the schema promises of the field."""
    shape = tuple(part if isinstance(part, int) else sizes[part] for part in f.shape)
    if f.kind == "times":
        return arrays(np.int64, shape, elements=st.integers(0, 2**31)).map(lambda a: a + 10**15)
    assert f.dtype is not None
    if f.order:
        return st.just(np.arange(shape[0]).astype(f.dtype))
    if f.dtype.kind == "f":
        low = 0.5 if f.above is not None else -1e6
        return arrays(f.dtype, shape, elements=st.floats(low, 1e6, width=32))
    hi = f.max if f.max is not None else int(np.iinfo(f.dtype).max)
    return arrays(f.dtype, shape, elements=st.integers(f.min or 0, hi))


def scalar(f: Field) -> st.SearchStrategy[Any]:
    if f.kind == "map":
        return st.dictionaries(TEXT, MAP_VALUES[f.values], max_size=3)
    if f.kind == "str":
        return st.sampled_from(f.choices) if f.choices else TEXT
    if f.kind == "int":
        return st.integers(f.min if f.min is not None else -(2**62), f.max if f.max is not None else 2**62)
    return st.booleans() if f.kind == "bool" else st.floats(allow_nan=False)


@st.composite
def messages(draw: st.DrawFn) -> Message:
    name = draw(st.sampled_from(sorted(MESSAGE_TYPES)))
    s: Schema = schema(name)
    sizes = {dim: draw(st.integers(0, 5)) for dim in s.dims}
    plain = {f.name: draw(scalar(f)) for f in s.fields if not f.shape}
    if "t_start_ns" in plain:
        plain["t_start_ns"] = plain["t_ns"] - 1
    if "n_selected" in plain:
        plain["n_selected"] += sizes["m"] if plain["n_selected"] < sizes["m"] else 0
    columns_ = {f.name: draw(columns(f, sizes)) for f in s.fields if f.shape}
    message: Message = MESSAGE_TYPES[name](**{f.name: {**plain, **columns_}[f.name] for f in s.fields})
    return message


def same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b)
    return bool(a == b)


@given(messages(), I64, I64)
def test_what_is_sent_comes_back_equal(message: Message, t_pub_ns: int, t_origin_ns: int) -> None:
    envelope = decode(encode(message, t_pub_ns, t_origin_ns), type(message))
    assert (envelope.t_pub_ns, envelope.t_origin_ns) == (t_pub_ns, t_origin_ns)
    for f in fields(message):
        assert same(getattr(message, f.name), getattr(envelope.message, f.name)), f.name


def decoded_or_refused(data: bytes) -> bool:
    """Whether a message came out; any exception but WireError ends the test."""
    try:
        decode(data)
    except WireError as e:
        assert e.reason.startswith("wire.") and " " not in e.reason
        return False
    return True


@given(st.binary(max_size=400))
def test_random_bytes_never_raise_anything_else(data: bytes) -> None:
    assert not decoded_or_refused(data)


@given(messages(), st.data())
def test_no_part_of_a_message_passes_for_a_message(message: Message, data: st.DataObject) -> None:
    whole = encode(message, 1)
    cut = data.draw(st.integers(0, len(whole) - 1))
    assert not decoded_or_refused(whole[:cut])


@settings(max_examples=300)
@given(messages(), st.data())
def test_a_mutated_message_is_decoded_or_refused(message: Message, data: st.DataObject) -> None:
    mutated = bytearray(encode(message, 1))
    for _ in range(data.draw(st.integers(1, 4))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    if decoded_or_refused(bytes(mutated)):
        again = decode(bytes(mutated)).message
        assert type(again) in MESSAGE_TYPES.values()


@settings(max_examples=300)
@given(messages(), st.data())
def test_views_are_what_msgpack_reads_or_nothing(message: Message, data: st.DataObject) -> None:
    mutated = bytearray(encode(message, 1))
    for _ in range(data.draw(st.integers(0, 2))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    views = unpack_views(mutated)
    if views is not None:
        copied = {name: bytes(v) if isinstance(v, memoryview) else v for name, v in views.items()}
        # Compared as bytes, because a number may have become NaN.
        assert msgpack.packb(copied) == msgpack.packb(msgpack.unpackb(mutated))


def test_a_message_of_columns_and_plain_values_is_read_as_views() -> None:
    packet = EventPacket(0, 5, "left", *(np.zeros(70_000, t) for t in (np.uint16, np.uint16, np.int64, np.uint8)))
    views = unpack_views(encode(packet, 1))
    assert views is not None
    assert isinstance(views["x"], memoryview) and views["x"].nbytes == 140_000
