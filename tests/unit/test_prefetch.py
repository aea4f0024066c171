"""Reading ahead."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from velod.runtime.prefetch import Packet, Prefetch
from velod.types import ImuPacket


def packet(seq: int) -> ImuPacket:
    return ImuPacket(seq, seq, np.arange(10, dtype=np.int64), np.zeros((10, 3)), np.zeros((10, 3)))


def test_packets_come_in_order_and_none_is_missing() -> None:
    assert [p.seq for p in Prefetch(map(packet, range(100)))] == list(range(100))


def test_no_more_is_held_than_allowed() -> None:
    taken: list[int] = []

    def source() -> Iterator[Packet]:
        for seq in range(50):
            taken.append(seq)
            yield packet(seq)

    ahead = Prefetch(source(), limit_bytes=5 * 720)
    ahead.fill(5.0)
    assert len(taken) <= 6
    assert [p.seq for p in ahead] == list(range(50))


def test_an_error_of_reading_comes_after_what_was_read_before_it() -> None:
    def source() -> Iterator[Packet]:
        yield packet(0)
        raise ValueError("times go backwards")

    packets = iter(Prefetch(source()))
    assert next(packets).seq == 0
    with pytest.raises(ValueError, match="backwards"):
        next(packets)
