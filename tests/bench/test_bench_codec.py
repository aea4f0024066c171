"""How long a message takes on its way to bytes and back. `make bench`"""

from __future__ import annotations

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from velod.types import EventPacket, Message, StereoBatch
from velod.wire import decode, encode

_RNG = np.random.default_rng(1)


def packet(n: int = 45_000) -> EventPacket:
    """A batch's worth of raw events."""
    return EventPacket(
        seq=0,
        t_ns=10_000_000,
        camera="left",
        x=_RNG.integers(0, 346, n).astype(np.uint16),
        y=_RNG.integers(0, 260, n).astype(np.uint16),
        event_t_ns=np.sort(_RNG.integers(0, 10_000_000, n)),
        p=_RNG.integers(0, 2, n).astype(np.uint8),
    )


def stereo(n: int = 500, h: int = 260, w: int = 346) -> StereoBatch:
    """500 selected events and the surfaces of a pair of DAVIS346."""
    x, y = _RNG.integers(0, w, n).astype(np.uint16), _RNG.integers(0, h, n).astype(np.uint16)
    pair = _RNG.integers(0, 65536, (2, 2, h, w)).astype(np.uint16)
    last = _RNG.integers(0, 65536, (2, h, w)).astype(np.uint16)
    age = _RNG.integers(1, 10_000_000, n).astype(np.uint32)
    return StereoBatch(0, 10_000_000, 0, 1526, x, y, age, np.ones(n, np.uint8), pair[0], pair[1], last[0], last[1])


@pytest.mark.parametrize("message", [packet(), stereo()], ids=lambda m: type(m).__name__)
def test_encode(benchmark: BenchmarkFixture, message: Message) -> None:
    assert len(benchmark(encode, message, 1)) > 400_000


@pytest.mark.parametrize("message", [packet(), stereo()], ids=lambda m: type(m).__name__)
def test_decode(benchmark: BenchmarkFixture, message: Message) -> None:
    data = encode(message, 1)
    assert benchmark(decode, data).message.seq == 0
