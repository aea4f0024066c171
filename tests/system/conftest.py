"""Recordings, and settings for runs with real processes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from tests import slanted_scene
from velod.config import DepthSettings, FlowSettings, Settings, ZenohSettings

BOXES = Path(__file__).parents[3] / "shared" / "data" / "boxes_esim.h5"


@pytest.fixture
def settings(port: int) -> Settings:
    """Default settings on a port of their own."""
    return Settings(zenoh=ZenohSettings(port=port))


def lossless(settings: Settings, workers: int = 1) -> Settings:
    """For replay at full speed, with so many flow and depth workers each."""
    return replace(
        settings,
        zenoh=replace(settings.zenoh, lossless=True),
        optimizer=replace(settings.optimizer, max_wait_ms=math.inf),
        flow=FlowSettings(workers=workers),
        depth=DepthSettings(workers=workers),
    )


@pytest.fixture(scope="session")
def slanted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five seconds of slanted edges."""
    return slanted_scene.write(tmp_path_factory.mktemp("recordings") / "slanted.h5", 5.0)


@pytest.fixture
def boxes() -> Path:
    """The public ESIM recording, where it is at hand."""
    if not BOXES.exists():
        pytest.skip("../shared/data/boxes_esim.h5 is not here")
    return BOXES
