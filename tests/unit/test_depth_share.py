"""Cameras that do not see the same give no velocity, and are said to."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from velod.config import Settings
from velod.io.recording import open_recording
from velod.optimizer.depth_share import ENOUGH, LEAST_SHARE, DepthShare, cameras_disagree
from velod.runtime.offline import run_offline
from velod.types import DepthBatch, EventPacket


def depths(n: int, of: int) -> DepthBatch:
    f4 = np.ones(n, np.float32)
    return DepthBatch(0, 0, of, np.arange(n, dtype=np.uint16), f4, f4, f4, np.ones(n, np.uint8))


def test_a_batch_is_judged_by_its_share_of_depths_where_it_has_events_to_judge_by():
    assert cameras_disagree(depths(19, 500))
    assert not cameras_disagree(depths(int(LEAST_SHARE * 500), 500))
    assert not cameras_disagree(depths(0, ENOUGH - 1))


def test_the_alarm_comes_within_a_second_and_goes_when_the_cameras_agree_again():
    share = DepthShare()
    for _ in range(75):
        share.add(depths(18, 500))
    assert share.alarm.startswith("6 % of the events find their match")
    for _ in range(10):
        share.add(depths(0, 3))
    assert share.alarm, "a few events say nothing"
    for _ in range(5):
        share.add(depths(400, 500))
    assert not share.alarm


def swapped(packet: EventPacket) -> EventPacket:
    return replace(packet, camera="left" if packet.camera == "right" else "right")


def mirrored(packet: EventPacket) -> EventPacket:
    return replace(packet, x=(345 - packet.x).astype(np.uint16))


@pytest.mark.parametrize("edit", [swapped, mirrored])
def test_no_velocity_of_swapped_or_mirrored_cameras_is_valid(
    simulated: Callable[[str, float], Path], edit: Callable[[EventPacket], EventPacket]
) -> None:
    recording = open_recording(simulated("boxes-4", 0.6))
    packets = (edit(p) if isinstance(p, EventPacket) else p for p in recording.packets())
    counters: dict[str, dict[str, int]] = {}
    velocities = run_offline(Settings(), recording.calibration, packets, counters=counters)
    assert len(velocities) > 40
    assert not any(v.valid for v in velocities)
    assert counters["optimizer"]["fit.few_depths"] > 20
    assert "depths of" in velocities[-1].reason
