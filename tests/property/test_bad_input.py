"""Whatever bytes come, decoders and readers answer with their own error, and take memory in proportion."""

from __future__ import annotations

import tracemalloc
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import slanted_scene
from velod.geometry.calibration import CalibrationError
from velod.geometry.calibration_files import load_calibration
from velod.io import RecordingError, open_recording
from velod.prove.examples import example_messages
from velod.prove.fuzz import fuzz
from velod.wire import WireError, decode, encode

MESSAGES = [encode(message, 1) for message in example_messages()]
SIZES = (b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x00\x10\x00\x00")


@pytest.mark.skipif(find_spec("atheris") is None, reason="atheris is not here (Linux, velod[fuzz])")
@pytest.mark.parametrize(
    ("decoder", "runs", "edges"), [("messages", 20_000, 150), ("calibration", 500, 60), ("settings", 500, 30)]
)
def test_a_fuzzer_finds_nothing_but_the_decoders_own_error(decoder: str, runs: int, edges: int) -> None:
    result = fuzz(decoder, runs, seed=1)
    assert result.crash == ""
    assert result.inputs >= runs
    assert result.edges >= edges, "it reached the decoder at all"
    assert result.peak_mib < 300


@settings(max_examples=300)
@given(st.sampled_from(MESSAGES), st.data())
def test_decoding_takes_memory_in_proportion_to_what_came(message: bytes, data: st.DataObject) -> None:
    """Also where a length that was sent promises gigabytes."""
    bad = bytearray(message * data.draw(st.sampled_from([1, 1, 100])))
    for _ in range(data.draw(st.integers(0, 3))):
        at = data.draw(st.integers(0, len(message) - 5))
        bad[at : at + 5] = data.draw(st.sampled_from([b"\xc6", b"\xdd", b"\xdf", b"\xc9", b"\xdb"])) + data.draw(
            st.sampled_from(SIZES)
        )
    tracemalloc.start()
    try:
        decode(bytes(bad))
    except WireError:
        pass
    finally:
        _, peak_bytes = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak_bytes < 16 * len(bad) + 65_536


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return slanted_scene.write(tmp_path_factory.mktemp("bad") / "short.h5", 0.1)


def read_or_refuse(path: Path) -> None:
    """All of it; only the readers' own errors may come."""
    try:
        for _ in open_recording(path).packets():
            pass
    except (RecordingError, CalibrationError):
        return


@settings(max_examples=150)
@given(st.data())
def test_a_recording_that_was_cut_short_or_damaged_is_read_or_refused(recording: Path, data: st.DataObject) -> None:
    whole = recording.read_bytes()
    bad = bytearray(whole[: data.draw(st.integers(0, len(whole)))] if data.draw(st.booleans()) else whole)
    for _ in range(data.draw(st.integers(0, 8)) if bad else 0):
        bad[data.draw(st.integers(0, min(len(bad), 20_000) - 1))] = data.draw(st.integers(0, 255))
    path = recording.with_name("damaged.h5")
    path.write_bytes(bad)
    read_or_refuse(path)


YAML = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


@settings(max_examples=300)
@given(st.data())
def test_a_calibration_with_alien_values_is_refused_by_name(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    tree = slanted_scene.RIG.to_tree()
    inner = tree[data.draw(st.sampled_from(sorted(tree)))]
    target = inner if isinstance(inner, dict) and inner and data.draw(st.booleans()) else tree
    target[data.draw(st.sampled_from(sorted(target)))] = data.draw(YAML)
    path = tmp_path_factory.getbasetemp() / "alien.yaml"
    path.write_text(yaml.safe_dump(tree), "utf-8")
    try:
        load_calibration(path)
    except CalibrationError as e:
        assert str(path) in str(e)
