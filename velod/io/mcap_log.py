"""Messages into an MCAP file while they come, for Foxglove, PlotJuggler and everything else that reads MCAP.

Small messages (velocity, odometry, health) are written as JSON with a JSON schema; those with columns of varying
length as the msgpack that travels on the wire (docs/messages.md). The package mcap is an extra, velod[mcap].
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from mcap.writer import CompressionType, Writer

from velod.types import Message
from velod.wire import Envelope, encode
from velod.wire.schema import Field, Schema, schema

_CHUNK_BYTES = 1 << 20
_JSON_TYPES = {"int": "integer", "float": "number", "bool": "boolean", "str": "string"}


class McapLog:
    """A context manager. What has been written can be read even where the process was killed (``mcap recover``)."""

    def __init__(self, path: str | Path, about: Mapping[str, str]) -> None:
        """``about``: stored as metadata. Raises OSError where the file cannot be written."""
        self._writer = Writer(str(path), chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(library="velod")
        self._writer.add_metadata("velod", dict(about))
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]

    def add(self, key: str, envelope: Envelope, t_received_ns: int) -> None:
        """One message that came on ``key``; log time: received, publish time: published (host clocks)."""
        message = envelope.message
        name = type(message).__name__
        if key not in self._channels:
            self._channels[key] = self._channel(key, schema(name))
        data = (
            json.dumps(to_json(message), allow_nan=False).encode()
            if is_small(schema(name))
            else encode(message, envelope.t_pub_ns, envelope.t_origin_ns)
        )
        self._writer.add_message(
            self._channels[key], t_received_ns, data, publish_time=envelope.t_pub_ns, sequence=message.seq % 2**32
        )

    def _channel(self, key: str, s: Schema) -> int:
        small = is_small(s)
        if s.name not in self._schemas:
            text = json.dumps(json_schema(s)).encode() if small else b""
            self._schemas[s.name] = self._writer.register_schema(s.name, "jsonschema" if small else "", text)
        return self._writer.register_channel(key, "json" if small else "msgpack", self._schemas[s.name])


def is_small(s: Schema) -> bool:
    """Whether every message of a schema is of about one, small, size."""
    return not s.dims


def to_json(message: Message) -> dict[str, Any]:
    """The fields of a small message as JSON knows them; NaN is null."""
    return {f.name: _plain(getattr(message, f.name)) for f in schema(type(message).__name__).fields}


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [_plain(v) for v in value] if value.ndim > 1 else [_plain(v) for v in value.tolist()]
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_schema(s: Schema) -> dict[str, Any]:
    """What ``to_json`` makes of a message, as a JSON schema."""
    return {"title": s.name, "type": "object", "properties": {f.name: _property(f) for f in s.fields}}


def _property(f: Field) -> dict[str, Any]:
    if f.kind == "map":
        return {"type": "object", "additionalProperties": {"type": _JSON_TYPES[f.values]}}
    if f.kind != "column":
        return {"type": _JSON_TYPES[f.kind]}
    nested: dict[str, Any] = {"type": "number"}
    for _ in f.shape:
        nested = {"type": "array", "items": nested}
    return nested
