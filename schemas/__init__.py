"""The contract for other languages, as data; read through ``velod.wire.schema``."""
