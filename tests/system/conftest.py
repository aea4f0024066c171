"""Recordings, and settings for runs with real processes."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import pytest

from tests import slanted_scene
from velod.config import DepthSettings, FlowSettings, Settings, ZenohSettings

BOXES = Path(__file__).parents[3] / "shared" / "data" / "boxes_esim.h5"
CALM_S = 20.0


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


@pytest.fixture
def calm() -> None:
    """Waits for a moment at which this process gets most of a core when it asks for one: for tests of real time.

    Where none comes within CALM_S the test begins all the same, and says what it says.
    """
    deadline_s = time.monotonic() + CALM_S
    share = 0.0
    while share < 0.8 and time.monotonic() < deadline_s:
        began_s, cpu_s = time.monotonic(), time.process_time()
        while (wall_s := time.monotonic() - began_s) < 0.2:
            pass
        share = (time.process_time() - cpu_s) / wall_s


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
