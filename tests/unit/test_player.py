"""Playing packets: pace, lead, and what a player says when the service does not answer."""

from __future__ import annotations

import time
from contextlib import ExitStack
from threading import Event

import numpy as np
import pytest
import zenoh

from velod.runtime import player
from velod.runtime.outlet import Outlet
from velod.runtime.player import LEAD_NS, PlayerError, play
from velod.runtime.stages import STAGES
from velod.types import ImuPacket, Velocity
from velod.wire import decode
from velod.wire.topics import ALIVE, EVENTS, IMU_SENSOR, VELOCITY, key

MS = 1_000_000


class FakeService:
    """Tokens of all stages, and every IMU packet with the time at which it came."""

    def __init__(self, session: zenoh.Session, answers: bool) -> None:
        self.came: list[tuple[int, float]] = []
        self.outlet = Outlet(session, "rig0")
        self._answers = answers
        self._stack = ExitStack()
        for stage in STAGES:
            token = key(ALIVE, "rig0", stage=stage, worker=f"{stage}-0")
            self._stack.enter_context(session.liveliness().declare_token(token))
        session.declare_subscriber(key(EVENTS, "rig0"), lambda s: None)
        session.declare_subscriber(key(IMU_SENSOR, "rig0"), self._on_imu)

    def _on_imu(self, sample: zenoh.Sample) -> None:
        t_ns = decode(sample.payload.to_bytes()).message.t_ns
        self.came.append((t_ns, time.monotonic()))
        if self._answers:
            velocity = Velocity(0, t_ns, np.zeros(3), np.eye(3), False, "initialising", "", -1, 0)
            self.outlet.publish(VELOCITY, velocity)


def packets(n: int, period_ms: int = 20) -> list[ImuPacket]:
    t_ns = [(5000 + i * period_ms) * MS for i in range(n)]
    return [ImuPacket(i, t, np.array([t]), np.zeros((1, 3)), np.zeros((1, 3))) for i, t in enumerate(t_ns)]


def test_real_time_is_sensor_time(session: zenoh.Session) -> None:
    service = FakeService(session, answers=True)
    play(session, "rig0", packets(25), 2.0, Event())
    assert [t for t, _ in service.came] == [p.t_ns for p in packets(25)]
    first_t_ns, first_s = service.came[0]
    late_s = [s - first_s - (t - first_t_ns) * 1e-9 / 2.0 for t, s in service.came]
    assert min(late_s) > -0.02, "early"
    assert np.median(late_s) < 0.02, "late"


def test_lossless_runs_no_further_ahead_than_the_lead(
    session: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(player, "STALL_S", 0.3)
    service = FakeService(session, answers=False)
    with pytest.raises(PlayerError, match=r"no progress for 0 s: the newest velocity is at 0\.000 s of sensor time"):
        play(session, "rig0", packets(100), None, Event())
    assert service.came[-1][0] - service.came[0][0] == LEAD_NS


def test_lossless_goes_on_with_every_velocity_to_the_end(session: zenoh.Session) -> None:
    service = FakeService(session, answers=True)
    start_s = time.monotonic()
    play(session, "rig0", packets(100), None, Event())
    assert [t for t, _ in service.came] == [p.t_ns for p in packets(100)]
    assert time.monotonic() - start_s < 2.0 + player.QUIET_S, "slower than real time"


def test_missing_stages_are_named(session: zenoh.Session) -> None:
    with (
        session.liveliness().declare_token(key(ALIVE, "rig0", stage="ingest", worker="ingest-0")),
        player.Service(session, "rig0") as service,
        pytest.raises(PlayerError, match=r"rig rig0: no flow, depth, optimizer worker is up"),
    ):
        service.wait_until_up(Event(), timeout_s=0.3)


@pytest.mark.parametrize("text", ["0", "-1", "fast", "nan"])
def test_a_speed_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(SystemExit):
        player.main(["file.h5", "--speed", text])
