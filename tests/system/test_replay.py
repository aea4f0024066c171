"""Recordings through four or more real processes."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.system.conftest import lossless
from velod.config import Settings
from velod.io import open_recording
from velod.runtime.offline import run_offline
from velod.runtime.online import OnlineError, OnlineResult, run_online
from velod.runtime.player import player_command
from velod.types import DepthBatch, FlowBatch, Message, Velocity
from velod.wire import encode
from velod.wire.topics import DEPTH, FLOW

pytestmark = pytest.mark.system

Batches = dict[tuple[str, int], bytes]


def note(batches: Batches, message: Message) -> None:
    """Keep the bytes of flow and depth batches."""
    if isinstance(message, FlowBatch | DepthBatch):
        batches[type(message).__name__, message.seq] = encode(message, 0)


def run(
    settings: Settings, recording: Path, speed: float | None, packets: str = "200hz"
) -> tuple[OnlineResult, Batches]:
    batches: Batches = {}
    command = player_command(str(recording), settings.zenoh, settings.rig.name, speed, packets)
    result = run_online(
        settings,
        open_recording(recording).calibration,
        command,
        on_message=lambda m: note(batches, m),
        topics=(FLOW, DEPTH),
        on_line=logging.getLogger("workers").info,
        spare=False,
    )
    return result, batches


@pytest.fixture(scope="module")
def offline_runs() -> dict[Path, tuple[list[Velocity], Batches]]:
    return {}


def offline(runs: dict[Path, tuple[list[Velocity], Batches]], recording: Path) -> tuple[list[Velocity], Batches]:
    """The same recording in one process; computed once."""
    if recording not in runs:
        batches: Batches = {}
        opened = open_recording(recording)
        velocities = run_offline(Settings(), opened.calibration, opened.packets(), lambda m: note(batches, m))
        runs[recording] = velocities, batches
    return runs[recording]


@pytest.mark.timed
@pytest.mark.data
@pytest.mark.usefixtures("calm")
def test_events_of_another_simulator_become_velocities_in_real_time(boxes: Path, settings: Settings) -> None:
    result, batches = run(settings, boxes, speed=1.0)
    assert result.gaps == 0
    valid = [p.velocity for p in result.velocities if p.velocity.valid]
    assert len(valid) > 60
    flow, depth = ({seq for kind, seq in batches if kind == name} for name in ("FlowBatch", "DepthBatch"))
    assert flow
    assert depth
    truth = open_recording(boxes).truth
    assert truth is not None
    errors = [
        np.linalg.norm(v.v_B - [np.interp(v.t_ns, truth.t_ns, truth.v_B[:, k]) for k in range(3)]) for v in valid
    ]
    assert np.median(errors) < 0.3


@pytest.mark.data
@pytest.mark.parametrize(("workers", "packets"), [(1, "random:7"), (2, "1000hz"), (3, "60hz")])
def test_lossless_runs_are_the_same_whoever_computes_and_however_packets_are_cut(
    boxes: Path, settings: Settings, offline_runs: dict, workers: int, packets: str
) -> None:
    velocities, batches = offline(offline_runs, boxes)
    result, online_batches = run(lossless(settings, workers), boxes, None, packets)
    assert result.drops() == {}
    assert online_batches.keys() == batches.keys()
    assert [k for k in batches if batches[k] != online_batches[k]] == [], "not bit-identical"
    published = [p.velocity for p in result.velocities]
    assert [v.t_ns for v in published] == [v.t_ns for v in velocities]
    assert max(np.abs(a.v_B - b.v_B).max() for a, b in zip(published, velocities, strict=True)) < 1e-9


@pytest.mark.timed
@pytest.mark.usefixtures("calm")
def test_the_slanted_edges_are_measured_in_real_time(slanted: Path, settings: Settings) -> None:
    result, _ = run(settings, slanted, speed=1.0)
    assert result.gaps == 0
    valid = [p.velocity for p in result.velocities if p.velocity.valid]
    assert len(valid) > 0.9 * 75 * 5
    assert np.median([np.linalg.norm(v.v_B - [-3.125, 0.0, 0.0]) for v in valid]) < 0.05
    latency = result.latency_percentiles_ms()
    assert latency is not None
    assert 0.0 < latency[0] < 100.0
    assert set(result.health) == {"ingest-0", "flow-0", "depth-0", "optimizer-0", "player-0", "supervisor"}


def test_a_recording_that_cannot_be_read_fails_the_run_by_name(settings: Settings, slanted: Path) -> None:
    command = player_command("no-such-file.h5", settings.zenoh, settings.rig.name)
    with pytest.raises(OnlineError, match=r"driver failed.*no-such-file.h5"):
        run_online(settings, open_recording(slanted).calibration, command, spare=False, on_line=lambda _: None)


def test_a_worker_that_cannot_start_fails_the_run_by_name(settings: Settings, slanted: Path) -> None:
    # A window of two knots passes no validation, so the workers refuse what the service serves.
    broken = replace(settings, optimizer=replace(settings.optimizer, window_s=0.1))
    command = player_command(str(slanted), settings.zenoh, settings.rig.name)
    with pytest.raises(OnlineError, match=r"does not stay alive.*window_s"):
        run_online(broken, open_recording(slanted).calibration, command, spare=False, on_line=lambda _: None)
