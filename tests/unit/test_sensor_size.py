"""Settings that follow the sensor: those of a DAVIS346 are the paper's, and a user's own are kept."""

from __future__ import annotations

import argparse

import pytest

from velod.cli.sim import add_options, recipe_of
from velod.config import ConfigError, Settings, from_tree
from velod.events.sensor_size import for_sensor


def followed(width: int, height: int, settings: Settings | None = None) -> tuple[int, float, int, int]:
    s = for_sensor(settings or Settings(), width, height)
    return s.ingest.count, s.ingest.period_ms, s.ingest.quota, s.depth.max_disparity_px


@pytest.mark.parametrize("size", [(346, 260), (240, 180), (128, 128)])
def test_up_to_a_davis346_they_are_the_papers(size: tuple[int, int]) -> None:
    assert followed(*size) == (45_000, 20.0, 500, 48)


def test_larger_sensors_get_larger_batches_more_events_and_a_wider_search() -> None:
    davis, vga, hd = followed(346, 260), followed(640, 480), followed(1280, 720)
    assert vga[0] / davis[0] == pytest.approx(640 * 480 / (346 * 260), rel=1e-3)
    assert vga[1] == 20.0
    assert hd[1] == pytest.approx(20.0 * 3.0**0.5)
    assert (vga[2], hd[2]) == (924, 1600)
    # The nearest depth stays: f b / max_disparity, where f goes with the width.
    assert (vga[3], hd[3]) == (89, 178)


def test_what_the_user_sets_stays() -> None:
    own = {"ingest": {"count": 1000, "period_ms": 5.0, "quota": 77}, "depth": {"max_disparity_px": 64}}
    assert followed(1280, 720, from_tree(own)) == (1000, 5.0, 77, 64)


@pytest.mark.parametrize(("key", "value"), [("count", 1), ("quota", 9), ("period_ms", 0.5)])
def test_between_0_and_the_least_nothing_is_allowed(key: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"ingest.{key}: must be at least"):
        from_tree({"ingest": {key: value}})


def test_a_simulated_sensor_of_any_size_sees_the_same_from_left_to_right() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("sequence")
    add_options(parser)
    davis, hd = (
        recipe_of(parser.parse_args(["boxes-4", *more])).calibration.left for more in ([], ["--sensor", "1280x720"])
    )
    assert (davis.width, davis.height, davis.fx, davis.cx, davis.cy) == (346, 260, 231.5, 172.5, 129.5)
    assert (hd.width, hd.height, hd.cx, hd.cy) == (1280, 720, 639.5, 359.5)
    assert hd.fx / hd.width == pytest.approx(davis.fx / davis.width)
    with pytest.raises(SystemExit):
        parser.parse_args(["boxes-4", "--sensor", "1280"])
