"""Event-by-event mode through the processes: parts of batches among two flow workers, the bits of one process."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.system.conftest import lossless
from velod.config import IngestSettings, Settings
from velod.eval.bench_input import RIG, record
from velod.io import open_recording
from velod.runtime.offline import run_offline
from velod.runtime.online import run_online
from velod.runtime.player import player_command
from velod.types import DepthBatch, FlowBatch, Message
from velod.wire import encode
from velod.wire.topics import DEPTH, FLOW

pytestmark = pytest.mark.system

Batches = dict[tuple[str, int], bytes]


def note(batches: Batches, message: Message) -> None:
    if isinstance(message, FlowBatch | DepthBatch):
        batches[type(message).__name__, message.seq] = encode(message, 0)


def test_flows_go_out_in_slices_and_the_result_is_that_of_one_process(settings: Settings, tmp_path: Path) -> None:
    path = tmp_path / "edges.h5"
    record(path, 0.6, seed=1)
    by_event = replace(lossless(settings, workers=2), ingest=IngestSettings(mode="event"))
    offline: Batches = {}
    online: Batches = {}
    velocities = run_offline(by_event, RIG, open_recording(path).packets(), lambda m: note(offline, m))
    result = run_online(
        by_event,
        RIG,
        player_command(str(path), by_event.zenoh, by_event.rig.name, None, "random:3"),
        on_message=lambda m: note(online, m),
        topics=(FLOW, DEPTH),
        on_line=logging.getLogger("workers").info,
        spare=False,
    )
    assert result.drops() == {}
    flows, depths = ([k for k in offline if k[0] == name] for name in ("FlowBatch", "DepthBatch"))
    assert len(flows) > 8 * len(depths) > 100
    assert online == offline
    published = [p.velocity for p in result.velocities]
    assert [v.t_ns for v in published] == [v.t_ns for v in velocities]
    assert max(np.abs(a.v_B - b.v_B).max() for a, b in zip(published, velocities, strict=True)) < 1e-9
