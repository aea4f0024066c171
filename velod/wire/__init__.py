"""Topics, message codec and schemas: what goes over the wire."""

from velod.wire.codec import Envelope, decode, encode, peek
from velod.wire.schema import WireError

__all__ = ["Envelope", "WireError", "decode", "encode", "peek"]
