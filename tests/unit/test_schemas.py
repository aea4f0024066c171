"""The schemas, the dataclasses and the documents speak of the same fields."""

from __future__ import annotations

import json
from dataclasses import MISSING, fields
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

from velod import types
from velod.wire.schema import MESSAGE_TYPES, schema

ROOT = Path(__file__).parents[2]
ARRAYS = {"u1": types.U8, "<u2": types.U16, "<u4": types.U32, "<i8": types.I64, "<f4": types.F32, "<f8": types.F64}
SCALARS = {"int": int, "float": float, "bool": bool, "str": str}
MAPS = {"int": dict[str, int], "float": dict[str, float], "str": dict[str, str]}
NAMES = sorted(MESSAGE_TYPES)


def python_type(tree: dict[str, object]) -> object:
    kind = str(tree["kind"])
    if kind == "column":
        return ARRAYS[str(tree["dtype"])]
    if kind == "times":
        return types.I64
    return MAPS[str(tree["values"])] if kind == "map" else SCALARS[kind]


@pytest.mark.parametrize("name", NAMES)
def test_schema_and_dataclass_have_the_same_fields_in_order_with_the_same_types(name: str) -> None:
    tree = json.loads((ROOT / "schemas" / f"{name}.v1.json").read_text("utf-8"))
    hints = get_type_hints(MESSAGE_TYPES[name])
    assert [f["name"] for f in tree["fields"]] == [f.name for f in fields(MESSAGE_TYPES[name])]
    assert {f["name"]: python_type(f) for f in tree["fields"]} == hints


@pytest.mark.parametrize("name", NAMES)
def test_every_field_says_what_it_means_and_every_number_its_unit(name: str) -> None:
    tree = json.loads((ROOT / "schemas" / f"{name}.v1.json").read_text("utf-8"))
    for f in tree["fields"]:
        assert f["doc"], f["name"]
        assert ("unit" in f) == (f["kind"] in ("int", "float", "column", "times")), f["name"]
        assert set(f.get("shape", [])) <= {*tree["dims"], *range(1, 26)}, f["name"]


@pytest.mark.parametrize("name", NAMES)
def test_columns_are_little_endian_and_their_shapes_refer_to_known_sizes(name: str) -> None:
    s = schema(name)
    for f in s.fields:
        assert all(isinstance(part, int) or part in s.dims for part in f.shape)
        if f.dtype is not None:
            assert f.dtype == f.dtype.newbyteorder("<") and f.dtype.kind in "iuf"
            assert np.dtype(f.dtype).itemsize <= 8


@pytest.mark.parametrize("name", NAMES)
def test_a_field_that_may_be_missing_has_the_default_of_the_dataclass_and_stands_after_all_others(name: str) -> None:
    of_class = {f.name: f for f in fields(MESSAGE_TYPES[name])}
    s = schema(name)
    assert [f.optional for f in s.fields] == sorted(f.optional for f in s.fields)
    for f in s.fields:
        if not f.optional:
            continue
        assert f.kind != "times"
        added = of_class[f.name]
        default = added.default if added.default_factory is MISSING else added.default_factory()
        if f.kind == "column":
            assert default.shape == tuple(0 if isinstance(part, str) else part for part in f.shape)
            assert default.dtype == f.dtype
        np.testing.assert_array_equal(default, np.full_like(default, f.default) if f.kind == "column" else f.default)


def test_every_schema_file_belongs_to_a_message_or_is_the_envelope() -> None:
    files = {p.name for p in (ROOT / "schemas").glob("*.json")}
    assert files == {f"{name}.v1.json" for name in [*MESSAGE_TYPES, "Envelope"]}


@pytest.mark.parametrize("name", [*NAMES, "Envelope"])
def test_the_document_for_other_languages_says_what_the_schema_says(name: str) -> None:
    text = (ROOT / "docs" / "messages.md").read_text("utf-8")
    heading = "Every message carries" if name == "Envelope" else f"### {name}\n"
    section = text.split(heading, 1)[1].split("\n#", 1)[0]
    rows = [line for line in section.splitlines() if line.startswith("| `")]
    tree = json.loads((ROOT / "schemas" / f"{name}.v1.json").read_text("utf-8"))
    assert [row.split("`")[1] for row in rows] == [f["name"] for f in tree["fields"]]
    for row, f in zip(rows, tree["fields"], strict=True):
        assert f["doc"] in row and f.get("dtype", "") in row and f.get("frame", "") in row, f["name"]
