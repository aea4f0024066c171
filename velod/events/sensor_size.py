"""Settings that follow the size of the sensor where they are 0: a larger one sees more edges, and each for longer."""

from __future__ import annotations

import math
from dataclasses import replace

from velod.config import DepthSettings, Settings

DAVIS346, VGA = (346, 260), (640, 480)
COUNT, QUOTA, MAX_DISPARITY_PX = 45_000, 500, 48
"""Of the DAVIS346 and of smaller sensors (Sec. V-A)."""
PERIOD_MS = 20.0
"""Up to VGA; beyond, what a batch costs to send and to match grows with the pixels."""


def for_sensor(settings: Settings, width: int, height: int) -> Settings:
    """The settings with nothing left to the sensor: ``count``, ``period_ms``, ``quota`` and ``max_disparity_px``.

    The count goes with the pixels: the time that a batch takes is that of the same motion on a DAVIS346. The quota
    goes with their root, as the length of edges does, the disparity with the width: the nearest depth stays.
    """
    pixels = width * height
    larger = max(1.0, pixels / (DAVIS346[0] * DAVIS346[1]))
    slower = max(1.0, math.sqrt(pixels / (VGA[0] * VGA[1])))
    s, d = settings.ingest, settings.depth
    return replace(
        settings,
        ingest=replace(
            s,
            count=s.count or round(COUNT * larger),
            period_ms=s.period_ms or PERIOD_MS * slower,
            quota=s.quota or round(QUOTA * math.sqrt(larger)),
        ),
        depth=replace(d, max_disparity_px=max_disparity_px(d, width)),
    )


def max_disparity_px(settings: DepthSettings, width: int) -> int:
    """How far matches are looked for on a sensor so wide."""
    return settings.max_disparity_px or math.ceil(MAX_DISPARITY_PX * max(1.0, width / DAVIS346[0]))
