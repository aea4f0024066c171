"""Per-stage errors on events of the public ESIM code, on other renderings, beside those on our own simulator's."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from velod.cli import main

ESIM = Path(__file__).parents[3] / "shared" / "data" / "boxes_esim.h5"


@pytest.fixture(scope="module")
def errors(simulated: Callable[[str, float], Path], tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """What ``velod eval --stages --json`` says of their events, and of ours."""
    if not ESIM.exists():
        pytest.skip("../shared/data/boxes_esim.h5 is not here")
    out = tmp_path_factory.mktemp("stages") / "out.json"
    assert main(["eval", str(ESIM), str(simulated("boxes-4", 0.6)), "--stages", "--json", str(out)]) == 0
    found: list[Any] = json.loads(out.read_text())
    return found


def test_stage_errors_on_esim_events_are_ours_within_a_factor_of_1_5(errors: list[Any]) -> None:
    theirs, ours = errors
    for part, name in (
        *(("flow", "spread"), ("flow", "sigmas")),
        *(("depth", "mad_px"), ("depth", "sigmas"), ("refined_depth", "mad_px"), ("depth", "z_spread")),
    ):
        assert 1 / 1.5 < theirs[part][name] / ours[part][name] < 1.5, (part, name)


def test_biases_on_esim_events_differ_from_ours_by_no_more_than_chance_and_a_tenth_of_the_spread(
    errors: list[Any],
) -> None:
    """Medians near zero have no ratio worth the name."""
    theirs, ours = errors
    for part, bias, error, spread in (
        ("flow", "bias", "bias_se", "spread"),
        ("refined_depth", "bias_px", "bias_se_px", "mad_px"),
    ):
        chance = 3.0 * math.hypot(theirs[part][error], ours[part][error])
        assert abs(theirs[part][bias] - ours[part][bias]) < chance + 0.1 * ours[part][spread], part


def test_depth_images_carried_to_the_events_tell_of_most_of_them(errors: list[Any]) -> None:
    theirs, ours = errors
    assert "depth images" in theirs["how"] and "ray casting" in ours["how"]
    assert theirs["judged"] > 0.75 and ours["judged"] > 0.75
