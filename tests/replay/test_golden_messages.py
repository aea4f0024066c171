"""Bytes that must decode for ever: what one version has sent, every later one reads as the same values."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from velod.wire import decode, encode
from velod.wire.schema import MESSAGE_TYPES

GOLDEN = Path(__file__).parent / "golden"


def stored(name: str) -> tuple[bytes, dict[str, Any]]:
    return (GOLDEN / f"{name}.v1.bin").read_bytes(), json.loads((GOLDEN / f"{name}.v1.json").read_text("utf-8"))


@pytest.mark.parametrize("name", sorted(MESSAGE_TYPES))
def test_stored_bytes_decode_to_the_stored_values(name: str) -> None:
    data, expected = stored(name)
    envelope = decode(data, MESSAGE_TYPES[name])
    assert (envelope.t_pub_ns, envelope.t_origin_ns) == (expected["t_pub_ns"], expected["t_origin_ns"])
    names = {f.name for f in fields(envelope.message)}
    assert names == set(expected["message"])
    for field_name in names:
        value = getattr(envelope.message, field_name)
        want = expected["message"][field_name]
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, np.array(want, value.dtype), err_msg=field_name)
        else:
            assert value == want, field_name


@pytest.mark.parametrize("name", sorted(MESSAGE_TYPES))
def test_a_decoded_message_is_sent_as_the_same_bytes(name: str) -> None:
    data, _ = stored(name)
    envelope = decode(data)
    assert encode(envelope.message, envelope.t_pub_ns, envelope.t_origin_ns) == data
