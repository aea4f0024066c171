"""What the codec refuses, and by which name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest

from velod.types import DepthBatch, EventPacket, FlowBatch, ImuSamples, Message, StereoBatch, Velocity
from velod.wire import WireError, codec, decode, encode

T = 1_000_000_000_000


def events(t_ns: list[int], **changes: Any) -> EventPacket:
    n = len(t_ns)
    packet = EventPacket(
        seq=0,
        t_ns=max(t_ns, default=T),
        camera="left",
        x=np.arange(n, dtype=np.uint16),
        y=np.arange(n, dtype=np.uint16),
        event_t_ns=np.array(t_ns, np.int64),
        p=np.ones(n, np.uint8),
    )
    return replace(packet, **changes)


def flow() -> FlowBatch:
    one = np.ones(3, np.float32)
    return FlowBatch(
        seq=4,
        t_ns=T,
        n_selected=9,
        index=np.array([0, 4, 8], np.uint16),
        age=np.array([1, 2, 3], np.uint32),
        x=one,
        y=one,
        n=np.tile(np.array([[1.0, 0.0]], np.float32), (3, 1)),
        speed=one,
        sigma=one,
    )


def velocity(**changes: Any) -> Velocity:
    v = Velocity(1, T, np.zeros(3), np.eye(3), True, "tracking", "", 4, T)
    return replace(v, **changes)


def imu() -> ImuSamples:
    return ImuSamples(0, T, T, 0, T, np.array([T - 1, T]), np.zeros((2, 3)), np.zeros((2, 3)))


def stereo() -> StereoBatch:
    plane = np.ones((2, 6, 4), np.uint16)
    none = np.zeros(0, np.uint16)
    return StereoBatch(
        0, T, T - 5, 1526, none, none, np.zeros(0, np.uint32), np.zeros(0, np.uint8), plane, plane, plane[0], plane[1]
    )


def depth() -> DepthBatch:
    one = np.ones(1, np.float32)
    return DepthBatch(0, T, 5, np.array([2], np.uint16), one, one, one, np.ones(1, np.uint8))


def altered(message: Message, change: Callable[[dict[str, Any]], object]) -> bytes:
    """The message's bytes after ``change`` has been at the map."""
    tree = msgpack.unpackb(encode(message, 1))
    change(tree)
    data: bytes = msgpack.packb(tree)
    return data


def column(dtype: str, *values: float) -> bytes:
    return np.array(values, dtype).tobytes()


REFUSED: list[tuple[str, Message, Callable[[dict[str, Any]], object]]] = [
    ("wire.schema_unknown", flow(), lambda m: m.update(schema="velod.FlowBatch2")),
    ("wire.schema_unknown", flow(), lambda m: m.update(schema="FlowBatch")),
    ("wire.schema_unknown", flow(), lambda m: m.pop("schema")),
    ("wire.version_alien", flow(), lambda m: m.update(v=2)),
    ("wire.version_alien", flow(), lambda m: m.pop("v")),
    ("wire.field_missing", flow(), lambda m: m.pop("speed")),
    ("wire.field_missing", flow(), lambda m: m.pop("t_pub_ns")),
    ("wire.field_type", flow(), lambda m: m.update(seq="4")),
    ("wire.field_type", flow(), lambda m: m.update(seq=True)),
    ("wire.field_type", flow(), lambda m: m.update(speed=1.0)),
    ("wire.field_type", velocity(), lambda m: m.update(valid=1)),
    ("wire.column_short", flow(), lambda m: m.update(speed=m["speed"][:-4])),
    ("wire.column_short", flow(), lambda m: m.update(speed=m["speed"][:-1])),
    ("wire.column_short", flow(), lambda m: m.update(n=m["n"][:-4])),
    ("wire.column_short", velocity(), lambda m: m.update(v_B=m["v_B"][:16])),
    ("wire.column_long", velocity(), lambda m: m.update(v_B=m["v_B"] + bytes(8))),
    ("wire.column_short", stereo(), lambda m: m.update(h=7)),
    ("wire.column_long", stereo(), lambda m: m.update(h=5)),
    ("wire.column_short", events([T, T + 1]), lambda m: m.update(dt=m["dt"][:4])),
    ("wire.too_large", stereo(), lambda m: m.update(h=1 << 40)),
    ("wire.bounds", stereo(), lambda m: m.update(h=-1)),
    ("wire.bounds", flow(), lambda m: m.update(seq=-1)),
    ("wire.bounds", flow(), lambda m: m.update(t_ns=2**63)),
    ("wire.bounds", flow(), lambda m: m.update(n_selected=8)),
    ("wire.bounds", flow(), lambda m: m.update(speed=column("<f4", 1.0, 0.0, 1.0))),
    ("wire.bounds", flow(), lambda m: m.update(age=column("<u4", 1, 0, 3))),
    ("wire.bounds", depth(), lambda m: m.update(refined=b"\x02")),
    ("wire.bounds", velocity(), lambda m: m.update(state="fine")),
    ("wire.bounds", events([T]), lambda m: m.update(camera="middle")),
    ("wire.bounds", events([T]), lambda m: m.update(t0_ns=2**63 - 1)),
    ("wire.order", flow(), lambda m: m.update(index=column("<u2", 0, 8, 4))),
    ("wire.time_backwards", imu(), lambda m: m.update(sample_t_ns=column("<i8", T, T))),
    ("wire.time_backwards", stereo(), lambda m: m.update(t_start_ns=T + 1)),
    ("wire.not_finite", flow(), lambda m: m.update(speed=column("<f4", 1.0, np.nan, 1.0))),
    ("wire.not_finite", depth(), lambda m: m.update(inv_depth=column("<f4", np.inf))),
    ("wire.not_finite", velocity(), lambda m: m.update(v_B=column("<f8", 0.0, np.nan, 0.0))),
]


@pytest.mark.parametrize(("reason", "message", "change"), REFUSED)
def test_a_broken_message_is_refused_by_name(
    reason: str, message: Message, change: Callable[[dict[str, Any]], object]
) -> None:
    with pytest.raises(WireError) as caught:
        decode(altered(message, change))
    assert caught.value.reason == reason


@pytest.mark.parametrize(
    ("reason", "data"),
    [
        ("wire.truncated", b""),
        ("wire.truncated", encode(events([T, T + 5]), 1)[:-1]),
        ("wire.not_msgpack", encode(events([T]), 1) + b"\x00"),
        ("wire.not_msgpack", b"\xc1"),
        ("wire.not_msgpack", msgpack.packb({"schema": [1, 2, 3]})),
        ("wire.not_map", b"\x07"),
        ("wire.not_map", msgpack.packb("velod.FlowBatch")),
    ],
)
def test_what_is_not_a_message_is_refused_by_name(reason: str, data: bytes) -> None:
    with pytest.raises(WireError) as caught:
        decode(data)
    assert caught.value.reason == reason


def test_a_message_of_another_type_than_expected_is_refused() -> None:
    with pytest.raises(WireError) as caught:
        decode(encode(flow(), 1), EventPacket)
    assert caught.value.reason == "wire.schema_unexpected"


def test_a_message_beyond_the_limit_is_refused_before_it_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    data = encode(flow(), 1)
    monkeypatch.setattr(codec, "MAX_BYTES", len(data) - 1)
    for attempt in (lambda: decode(data), lambda: encode(flow(), 1)):
        with pytest.raises(WireError) as caught:
            attempt()
        assert caught.value.reason == "wire.too_large"


def test_a_field_that_a_later_version_adds_is_ignored() -> None:
    envelope = decode(altered(flow(), lambda m: m.update(quality=0.5)))
    assert isinstance(envelope.message, FlowBatch)


def test_a_field_that_an_earlier_velod_did_not_send_has_its_default() -> None:
    added = ("age_ms", "up_B", "up_cov", "frame", "degenerate", "degenerate_B")
    sent = velocity(age_ms=3.0, up_B=np.ones(3), up_cov=np.eye(3), frame="camera")
    message = decode(altered(sent, lambda m: [m.pop(name) for name in added])).message
    assert isinstance(message, Velocity)
    assert np.isnan(message.age_ms) and message.frame == "imu"
    assert message.up_B.shape == (3,) and message.up_cov.shape == (3, 3)
    assert np.isnan(message.up_B).all() and np.isnan(message.up_cov).all()


def test_a_field_that_may_be_missing_is_checked_where_it_is_sent() -> None:
    for name, value in (("up_B", b"12"), ("frame", 3), ("age_ms", "old")):
        with pytest.raises(WireError) as caught:
            decode(altered(velocity(), lambda m, name=name, value=value: m.update({name: value})))
        assert caught.value.reason in ("wire.field_type", "wire.column_short")


def test_the_origin_may_be_left_out() -> None:
    assert decode(altered(flow(), lambda m: m.pop("t_origin_ns"))).t_origin_ns == 0


def test_an_estimate_that_is_not_valid_may_hold_nan() -> None:
    message = decode(encode(velocity(v_B=np.full(3, np.nan), valid=False, state="lost"), 1)).message
    assert isinstance(message, Velocity) and np.isnan(message.v_B).all() and not message.valid


def test_a_packet_longer_than_the_offsets_reach_is_refused_with_its_span() -> None:
    decode(encode(events([T, T + 2**32 - 1]), 1))
    with pytest.raises(WireError, match=r"spans 4\.295 s") as caught:
        encode(events([T, T + 2**32]), 1)
    assert caught.value.reason == "wire.span"


def test_times_that_run_backwards_reach_ingest_as_they_are() -> None:
    message = decode(encode(events([T + 5, T, T + 9]), 1)).message
    assert isinstance(message, EventPacket)
    assert message.event_t_ns.tolist() == [T + 5, T, T + 9]


@pytest.mark.parametrize(
    ("reason", "changes"),
    [
        ("wire.dtype", {"x": np.zeros(2, np.int64)}),
        ("wire.dtype", {"x": [1, 2]}),
        ("wire.shape", {"x": np.zeros(3, np.uint16)}),
        ("wire.shape", {"p": np.zeros((2, 1), np.uint8)}),
        ("wire.field_type", {"seq": "4"}),
    ],
)
def test_what_does_not_fit_the_schema_is_not_sent(reason: str, changes: dict[str, Any]) -> None:
    with pytest.raises(WireError) as caught:
        encode(events([T, T + 1], **changes), 1)
    assert caught.value.reason == reason


def test_decoded_arrays_are_of_the_kind_that_kernels_were_compiled_for() -> None:
    message = decode(encode(stereo(), 1)).message
    assert isinstance(message, StereoBatch)
    for a in (message.left, message.right, message.left_last, message.x):
        assert a.flags.c_contiguous and a.flags.aligned and a.flags.writeable and a.dtype == np.uint16


def test_a_full_batch_of_raw_events_is_nine_bytes_an_event() -> None:
    n = 45_000
    packet = events(list(range(T, T + n)))
    assert 9 * n < len(encode(packet, 1)) < 9 * n + 256


@pytest.mark.parametrize("n", [0, 1, 255, 256, 65_535, 65_536])
def test_the_bytes_are_those_that_msgpack_itself_makes_of_the_map(n: int) -> None:
    data = encode(events([T] * n, x=np.zeros(n, np.uint16), y=np.zeros(n, np.uint16)), 1)
    assert msgpack.packb(msgpack.unpackb(data)) == data
