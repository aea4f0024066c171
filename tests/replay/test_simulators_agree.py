"""Per-stage errors on events of the public ESIM code, on other renderings, beside those on our own simulator's."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from velod.config import Settings
from velod.eval.stage_errors import StageErrors, stage_errors
from velod.io import open_recording, read_depth
from velod.runtime.offline import run_offline
from velod.types import DepthBatch, FlowBatch, Message

ESIM = Path(__file__).parents[3] / "shared" / "data" / "boxes_esim.h5"


def errors_on(path: Path) -> StageErrors:
    recording, depth = open_recording(path), read_depth(path)
    assert recording.truth is not None
    assert depth is not None
    flows: list[FlowBatch] = []
    depths: list[DepthBatch] = []

    def keep(message: Message) -> None:
        if isinstance(message, FlowBatch):
            flows.append(message)
        elif isinstance(message, DepthBatch):
            depths.append(message)

    run_offline(Settings(), recording.calibration, recording.packets(), keep)
    return stage_errors(recording.calibration, recording.truth, depth, flows, depths)


def test_stage_errors_on_esim_events_are_ours_within_a_factor_of_1_5(
    simulated: Callable[[str, float], Path],
) -> None:
    if not ESIM.exists():
        pytest.skip("../shared/data/boxes_esim.h5 is not here")
    theirs, ours = errors_on(ESIM), errors_on(simulated("boxes-4", 0.6))
    for name in ("flow_spread", "flow_sigmas", "disparity_mad_px", "disparity_sigmas"):
        assert 1 / 1.5 < getattr(theirs, name) / getattr(ours, name) < 1.5, name
    # Medians near zero have no ratio worth the name.
    assert abs(theirs.flow_bias - ours.flow_bias) < 0.01
    assert abs(theirs.disparity_bias_px - ours.disparity_bias_px) < 0.03
