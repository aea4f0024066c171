"""One decoder under a coverage-guided fuzzer (atheris, which is libFuzzer): ``python -P -m velod.prove.fuzz_target``.

What a decoder is given, it returns a message or raises its one error; anything else, and any allocation beyond
LIMIT_BYTES, ends the process with the input that did it. Half of the inputs for messages are mutated as bytes, the
others field by field: bytes alone seldom get past the first check.
"""

from __future__ import annotations

import random
import resource
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import atheris
import msgpack

with atheris.instrument_imports(include=["velod.wire", "velod.config", "velod.geometry"]):
    from velod import config
    from velod.geometry import calibration_files
    from velod.geometry.calibration import CalibrationError
    from velod.wire import WireError, codec, topics

from velod.prove.examples import example_messages, plain_rig

LIMIT_BYTES = 1 << 30
"""Of address space beyond what the process has at its start."""
_WEIRD: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2**31, 2**32, 2**63 - 1, -(2**63), 2**64 - 1, 0.5, float("nan"), float("inf"), "", "left",
    b"", b"\x00", bytes(8), bytes(24), bytes(72), b"\xff" * 16, {}, {"a": 1}, {"a": "b"},
)  # fmt: skip


def decode_message(data: bytes) -> None:
    """Any message; what is decoded must survive the way back."""
    try:
        envelope = codec.decode(data)
    except WireError:
        return
    again = codec.decode(codec.encode(envelope.message, envelope.t_pub_ns, envelope.t_origin_ns))
    assert type(again.message) is type(envelope.message)


def read_settings(data: bytes) -> None:
    """A settings file."""
    try:
        config.loads(data.decode("utf-8", "replace"))
    except config.ConfigError:
        return


def read_calibration(data: bytes) -> None:
    """A calibration file of any kind."""
    _SCRATCH.write_bytes(data)
    try:
        calibration_files.load_calibration(_SCRATCH)
    except CalibrationError:
        return


def read_key(data: bytes) -> None:
    """A key from the network."""
    for topic in topics.TOPICS.values():
        try:
            topics.parts(topic, data.decode("utf-8", "replace"))
        except ValueError:
            continue


_SCRATCH = Path(tempfile.gettempdir()) / f"velod-fuzz-{random.SystemRandom().getrandbits(64):x}"
DECODERS: dict[str, Callable[[bytes], None]] = {
    "messages": decode_message,
    "settings": read_settings,
    "calibration": read_calibration,
    "keys": read_key,
}


def seeds(decoder: str) -> list[bytes]:
    """Good inputs to begin from."""
    if decoder == "messages":
        return [codec.encode(message, 1) for message in example_messages()]
    if decoder == "settings":
        return [config.to_toml(config.Settings(), explain=False).encode()]
    if decoder == "calibration":
        calibration_files.save_calibration(_SCRATCH, plain_rig())
        return [_SCRATCH.read_bytes()]
    return [topic.template.format(rig="rig0", camera="left", stage="flow", worker="flow-0").encode()
            for topic in topics.TOPICS.values()]  # fmt: skip


def mutate_fields(data: bytes, max_size: int, seed: int) -> bytes:
    """One field of a message replaced, taken away or doubled in length; bytes as they are for what is no message."""
    choice = random.Random(seed)
    if choice.random() < 0.5:
        return bytes(atheris.Mutate(data, max_size))
    try:
        tree = msgpack.unpackb(data, max_bin_len=max_size, max_map_len=64, max_array_len=64)
        assert isinstance(tree, dict) and tree
    except Exception:
        return bytes(atheris.Mutate(data, max_size))
    name = choice.choice(list(tree))
    value = tree[name]
    kind = choice.randrange(4)
    if kind == 0:
        del tree[name]
    elif kind == 1 or not isinstance(value, bytes | str | int):
        tree[name] = choice.choice(_WEIRD)
    elif isinstance(value, int):
        tree[name] = max(-(2**63), min(2**63 - 1, value + choice.choice((-1, 1, -(2**32), 2**40))))
    elif isinstance(value, str):
        tree[name] = value[:-1] if kind == 2 else value * 2
    else:
        tree[name] = value + value[: choice.choice((1, 2, 8, len(value)))] if kind == 2 else value[: len(value) // 2]
    return bytes(msgpack.packb(tree))[:max_size]


def main() -> None:
    """Arguments: the decoder, a folder for the corpus, then libFuzzer's own."""
    decoder, corpus = sys.argv[1], Path(sys.argv[2])
    for i, data in enumerate(seeds(decoder)):
        (corpus / f"seed-{i}").write_bytes(data)
    with Path("/proc/self/statm").open() as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + LIMIT_BYTES, used + LIMIT_BYTES))
    mutator = {"custom_mutator": mutate_fields} if decoder == "messages" else {}
    atheris.Setup([sys.argv[0], str(corpus), *sys.argv[3:]], DECODERS[decoder], **mutator)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
