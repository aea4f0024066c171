"""Messages whose columns stay where they lie: the same values, and what the stages make of them is the same."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from velod.config import Settings
from velod.runtime import warmup
from velod.runtime.stages import create_stage
from velod.types import Message, StereoBatch
from velod.wire import decode, encode

CALIBRATION = warmup.plain_calibration()
MESSAGES = {
    "ingest": list(warmup._packets(CALIBRATION)),
    "flow": list(warmup._event_batches(CALIBRATION)),
    "depth": list(warmup._stereo_batches(CALIBRATION)),
}
EVEN_AND_ODD = (1, 200)
"""Numbers of messages whose columns begin a byte apart."""


def assert_equal(a: Message, b: Message) -> None:
    for field in fields(a):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), field.name)


@pytest.mark.parametrize("seq", EVEN_AND_ODD)
@pytest.mark.parametrize("stage", MESSAGES)
def test_a_stage_makes_the_same_of_a_message_in_place(stage: str, seq: int) -> None:
    copied, placed = (create_stage(stage, Settings(), CALIBRATION) for _ in range(2))
    out = 0
    for message in MESSAGES[stage]:
        data = encode(replace(message, seq=seq), 1)
        copy, view = decode(data).message, decode(data, in_place=True).message
        assert_equal(copy, view)
        for a, b in zip(copied.handle(copy), placed.handle(view), strict=True):
            assert_equal(a, b)
            out += 1
    assert out > 0


def test_columns_of_a_large_message_are_not_copied_wherever_they_lie() -> None:
    odd = []
    for seq in EVEN_AND_ODD:
        data = encode(replace(MESSAGES["depth"][0], seq=seq), 1)
        message = decode(data, in_place=True).message
        assert isinstance(message, StereoBatch)
        assert np.shares_memory(message.left, np.frombuffer(data, np.uint8)) and not message.left.flags.writeable
        odd.append(message.left.ctypes.data % 2)
    assert sorted(odd) == [0, 1]
