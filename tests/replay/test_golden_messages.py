"""Bytes that must decode for ever: what one version has sent, every later one reads as the same values.

``<message>.v1.bin`` are the first bytes of version 1, ``<message>.v1.<n>.bin`` have the fields that were added since.
"""

from __future__ import annotations

import json
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from velod.wire import decode, encode
from velod.wire.schema import MESSAGE_TYPES

GOLDEN = Path(__file__).parent / "golden"
STORED = sorted(path.stem for path in GOLDEN.glob("*.bin"))
NEWEST = [max(stem for stem in STORED if stem.split(".")[0] == name) for name in sorted(MESSAGE_TYPES)]


def stored(stem: str) -> tuple[bytes, dict[str, Any]]:
    return (GOLDEN / f"{stem}.bin").read_bytes(), json.loads((GOLDEN / f"{stem}.json").read_text("utf-8"))


def assert_same(value: Any, want: Any, name: str) -> None:
    if isinstance(value, np.ndarray):
        np.testing.assert_array_equal(value, np.array(want, value.dtype), err_msg=name)
    else:
        assert value == want or (value != value and want != want), name


@pytest.mark.parametrize("stem", STORED)
def test_stored_bytes_decode_to_the_stored_values(stem: str) -> None:
    data, expected = stored(stem)
    envelope = decode(data, MESSAGE_TYPES[stem.split(".")[0]])
    assert (envelope.t_pub_ns, envelope.t_origin_ns) == (expected["t_pub_ns"], expected["t_origin_ns"])
    added = {f.name: f for f in fields(envelope.message)}
    for name, want in expected["message"].items():
        assert_same(getattr(envelope.message, name), want, name)
        del added[name]
    # what was added later has the default
    for name, f in added.items():
        default = f.default if f.default_factory is MISSING else f.default_factory()
        assert default is not MISSING, name
        assert_same(getattr(envelope.message, name), default, name)


@pytest.mark.parametrize("stem", NEWEST)
def test_the_newest_bytes_hold_every_field_and_are_sent_as_the_same_again(stem: str) -> None:
    data, expected = stored(stem)
    envelope = decode(data)
    assert {f.name for f in fields(envelope.message)} == set(expected["message"])
    assert encode(envelope.message, envelope.t_pub_ns, envelope.t_origin_ns) == data
