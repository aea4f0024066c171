"""A consumer that discards everything as too old learns of it, once, and why."""

from __future__ import annotations

import logging
import math
import time

import numpy as np
import pytest

from velod.client import Received, VelocityClient
from velod.runtime.staleness import StaleStream
from velod.types import Velocity
from velod.wire import decode, encode
from velod.wire.topics import VELOCITY, key

MS = 1_000_000


@pytest.mark.parametrize(
    ("published_ms", "way_ms", "waited_ms", "cause"),
    [
        (1300.0, 4.0, 2.0, "they are 1.3 s old already when they are published"),
        (10.0, 3210.0, 2.0, "they arrive 3.21 s after they were published: the publisher's clock is as far behind"),
        (10.0, 4.0, 900.0, "they wait here for 0.9 s: receive() is called too rarely"),
        (math.nan, 3210.0, 2.0, "they arrive 3.21 s after they were published"),
        (1300.0, math.nan, 2.0, "they are 1.3 s old already"),
    ],
)
def test_the_largest_part_of_the_age_is_named(
    published_ms: float, way_ms: float, waited_ms: float, cause: str
) -> None:
    stream = StaleStream()
    said = [stream.stale(published_ms, way_ms, waited_ms, n * 20 * MS) for n in range(100)]
    assert [n for n, text in enumerate(said) if text] == [50]  # after a second of them, and not again
    assert said[50].startswith(cause)


def test_a_burst_of_what_was_held_up_is_not_worth_a_word() -> None:
    stream = StaleStream()
    for n in range(200):
        now_ns = n * 20 * MS
        assert not stream.stale(10.0, 700.0, 0.0, now_ns)
        if n % 40 == 39:  # after .8 s
            stream.fresh()


def test_it_is_said_again_after_a_minute() -> None:
    stream = StaleStream()
    said = [stream.stale(10.0, 700.0, 0.0, n * 100 * MS) for n in range(1300)]
    assert [n for n, text in enumerate(said) if text] == [10, 610, 1210]


class Late:
    """A listener to a publisher whose clock is ``behind_s`` behind."""

    def __init__(self, behind_s: float, count: int) -> None:
        self._behind_ns, self._left = int(behind_s * 1e9), count

    def receive(self, timeout_s: float) -> Received | None:
        self._left -= 1
        if self._left < 0:
            return None
        velocity = Velocity(0, 0, np.zeros(3), np.eye(3), True, "tracking", "", 0, 0, age_ms=10.0)
        now_ns = time.time_ns()
        envelope = decode(encode(velocity, now_ns - self._behind_ns), Velocity)
        return Received(VELOCITY, key(VELOCITY, "drone"), envelope, now_ns, 0)


def test_a_client_whose_publishers_clock_is_behind_says_so_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(StaleStream, "AFTER_NS", 0)
    client = VelocityClient("drone")
    monkeypatch.setattr(client, "_listener", Late(3.2, 50))
    with caplog.at_level(logging.WARNING, "velod.client"):
        assert client.receive() is None
    (record,) = caplog.records
    assert record.getMessage().startswith("all velocities of drone are older than max_age_s (0.2 s): they arrive 3.2")
