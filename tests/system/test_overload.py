"""More load than a process can take: less is taken on, nothing gets old, and afterwards all is as before."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import slanted_scene
from velod.config import Settings
from velod.io import open_recording
from velod.runtime.online import OnlineResult, run_online
from velod.runtime.player import player_command
from velod.runtime.supervisor import Supervisor
from velod.types import Health
from velod.wire import decode
from velod.wire.topics import HEALTH, key

pytestmark = [pytest.mark.system, pytest.mark.timed]

SECONDS = 7.0
MAX_AGE_S = 1.0
"""Of the newest batch in a velocity."""
MAX_LAG_S = 1.0
"""Of a velocity behind the most punctual one."""
SLOW_S = (1.0, 4.0)
"""From the first velocity on: when the process is slowed down, and when not any more."""
RUN_S, STOPPED_S = 0.005, 0.055
"""A slowed process runs for so long, then stands still for so long: a core that is twelve times as slow."""


class Slowdown(threading.Thread):
    """Stops and continues a process, over and over."""

    def __init__(self, pid: int) -> None:
        super().__init__(daemon=True)
        self._pid = pid
        self._over = threading.Event()

    def run(self) -> None:
        while not self._over.wait(RUN_S):
            os.kill(self._pid, signal.SIGSTOP)
            time.sleep(STOPPED_S)
            os.kill(self._pid, signal.SIGCONT)

    def end(self) -> None:
        self._over.set()
        self.join()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return slanted_scene.write(tmp_path_factory.mktemp("recordings") / "slanted.h5", SECONDS)


class Watched:
    """Slows one worker down in the middle of a run, and keeps what ingest said of its health."""

    def __init__(self, worker: str) -> None:
        self.health: list[tuple[float, Health]] = []  # with the time since the first velocity, s
        self.begun_ns = 0
        self._worker = worker
        self._subscriber: Any = None
        self._slowdown: Slowdown | None = None

    def on_velocity(self, _: object) -> None:
        self.begun_ns = self.begun_ns or time.time_ns()

    def on_step(self, supervisor: Supervisor) -> None:
        if self._subscriber is None:
            self._subscriber = supervisor.session.declare_subscriber(
                key(HEALTH, "rig0", worker="ingest-0"), self._on_health
            )
        now_s = self._now_s()
        if self._slowdown is None and SLOW_S[0] < now_s < SLOW_S[1]:
            self._slowdown = Slowdown(supervisor.process_ids()[self._worker])
            self._slowdown.start()
        elif self._slowdown is not None and self._slowdown.is_alive() and now_s > SLOW_S[1]:
            self._slowdown.end()

    def _on_health(self, sample: Any) -> None:
        message = decode(sample.payload.to_bytes()).message
        if self.begun_ns:
            self.health.append((self._now_s(), message))

    def _now_s(self) -> float:
        return (time.time_ns() - self.begun_ns) * 1e-9 if self.begun_ns else -1.0

    def alarms(self, name: str, start_s: float, end_s: float) -> list[bool]:
        """Whether each health message of a time had the alarm."""
        return [name in h.alarms for t_s, h in self.health if start_s < t_s < end_s]

    def grown(self, name: str, start_s: float, end_s: float) -> int:
        """By how much a counter grew between the first and the last health message of a time."""
        counts = [h.counters.get(name, 0) for t_s, h in self.health if start_s < t_s < end_s]
        return counts[-1] - counts[0]


def slowed(settings: Settings, recording: Path, worker: str) -> tuple[OnlineResult, Watched]:
    watched = Watched(worker)
    result = run_online(
        settings,
        open_recording(recording).calibration,
        player_command(str(recording), settings.zenoh, settings.rig.name, packets="60hz"),
        on_velocity=watched.on_velocity,
        on_step=watched.on_step,
        on_line=lambda _: None,
        spare=False,
    )
    return result, watched


def late_s(result: OnlineResult) -> np.ndarray:
    """How much later than the most punctual one each velocity was published, and its newest batch's age in it, s."""
    lag = np.array([p.t_pub_ns - p.velocity.t_ns for p in result.velocities if p.velocity.valid]) * 1e-9
    age = np.array([p.velocity.t_ns - p.velocity.batch_t_ns for p in result.velocities if p.velocity.valid]) * 1e-9
    return np.stack([lag - lag.min(), age])


def assert_as_before(result: OnlineResult, watched: Watched) -> None:
    """The end of the run: no alarm, nothing shed, and the velocity right."""
    last = watched.health[-1][1]
    assert not [name for name in last.alarms if name.startswith("load.")]
    last_velocities = [p.velocity.v_B for p in result.velocities if p.velocity.valid][-50:]
    assert np.median(np.linalg.norm(last_velocities - slanted_scene.V_B, axis=1)) < 0.1
    assert result.restarts == dict.fromkeys(result.restarts, 0)


def test_a_slow_depth_worker_gets_less_and_no_batch_gets_old(settings: Settings, recording: Path) -> None:
    result, watched = slowed(settings, recording, "depth-0")
    _, age = late_s(result)
    assert all(watched.alarms("load.selection", SLOW_S[0] + 1.2, SLOW_S[1]))
    assert watched.grown("shed.batches", *SLOW_S) > 10
    assert age.max() < MAX_AGE_S
    assert_as_before(result, watched)


def test_a_slow_ingest_makes_fewer_batches_and_stays_in_the_present(settings: Settings, recording: Path) -> None:
    result, watched = slowed(settings, recording, "ingest-0")
    lag, _ = late_s(result)
    assert any(watched.alarms("load.selection", SLOW_S[0] + 1.2, SLOW_S[1] + 1.0))
    assert lag.max() < MAX_LAG_S
    assert_as_before(result, watched)
