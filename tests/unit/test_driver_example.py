"""The example driver packs what velod decodes."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from velod.config import Settings
from velod.geometry.calibration_files import load_calibration
from velod.runtime.offline import run_offline
from velod.types import EventPacket, ImuPacket
from velod.wire import decode

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def driver() -> dict[str, Any]:
    return runpy.run_path(str(EXAMPLES / "driver.py"), run_name="driver")


def test_the_example_driver_and_its_calibration_give_the_velocity_that_it_promises(driver: dict[str, Any]) -> None:
    packets: list[EventPacket | ImuPacket] = []
    for seq in range(300):
        start_ns, end_ns = seq * driver["PERIOD_NS"], (seq + 1) * driver["PERIOD_NS"]
        for side in ("left", "right"):
            data = driver["event_packet"](seq, end_ns, side, *driver["read_camera"](side, start_ns, end_ns))
            packets.append(decode(data, EventPacket).message)
        packets.append(decode(driver["imu_packet"](seq, *driver["read_imu"](start_ns)), ImuPacket).message)
    velocities = run_offline(Settings(), load_calibration(EXAMPLES / "rig.yaml"), packets)
    valid = np.array([v.v_B for v in velocities if v.valid])
    assert len(valid) > 60
    assert np.median(valid, axis=0) == pytest.approx([-1.25, 0.0, 0.0], abs=0.02)


def test_events_of_the_example_driver_are_decoded(driver: dict[str, Any]) -> None:
    events = driver["read_camera"]("right", 10_000_000, 15_000_000)
    packet = decode(driver["event_packet"](2, 15_000_000, "right", *events), EventPacket).message
    assert isinstance(packet, EventPacket)
    assert (packet.seq, packet.t_ns, packet.camera) == (2, 15_000_000, "right")
    for got, sent in zip((packet.event_t_ns, packet.x, packet.y, packet.p), events, strict=True):
        assert np.array_equal(got, sent)


def test_a_packet_without_events_moves_the_watermark(driver: dict[str, Any]) -> None:
    nothing = np.empty(0, np.int64)
    packet = decode(driver["event_packet"](3, 20_000_000, "left", *[nothing] * 4), EventPacket).message
    assert isinstance(packet, EventPacket)
    assert (packet.t_ns, len(packet.x)) == (20_000_000, 0)


def test_imu_samples_of_the_example_driver_are_decoded(driver: dict[str, Any]) -> None:
    packet = decode(driver["imu_packet"](4, *driver["read_imu"](7_000_000)), ImuPacket).message
    assert isinstance(packet, ImuPacket)
    assert packet.sample_t_ns.tolist() == [7_000_000]
    assert packet.accel[0] == pytest.approx([0.0, -9.81, 0.0], abs=0.2)
    assert packet.gyro.shape == (1, 3)
