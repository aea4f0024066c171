"""A service spread over several supervisors, and one behind a router."""

from __future__ import annotations

import logging
import socket
import time
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread

import pytest
import zenoh

from velod.config import FlowSettings, Settings, ZenohSettings
from velod.io import open_recording
from velod.runtime.online import run_online
from velod.runtime.player import play, player_command
from velod.runtime.session import open_session
from velod.runtime.settings_service import NoServiceError
from velod.runtime.supervisor import Supervisor
from velod.wire import decode
from velod.wire.topics import FLOW, VELOCITY, key

pytestmark = pytest.mark.system
ROUTED = Path(__file__).parents[2] / "deploy" / "zenoh" / "behind-a-router.json5"


def test_a_stage_on_another_host_needs_an_endpoint_only(slanted: Path, settings: Settings) -> None:
    """Two supervisors, as on two hosts: the second knows nothing but where the first is."""
    recording = open_recording(slanted)
    # A setting that the far workers can only have from the service: no flow at all survives it.
    here = replace(settings, flow=FlowSettings(max_speed_px_s=1.0))
    there = Settings(zenoh=ZenohSettings(connect=f"tcp/127.0.0.1:{settings.zenoh.port}"))
    log = logging.getLogger("workers").info
    velocities, flows, stop = [], [], Event()
    with (
        Supervisor(here, recording.calibration, ("ingest", "depth", "optimizer"), spare=False, on_line=log) as first,
        Supervisor(there, None, ("flow",), spare=False, on_line=log) as second,
    ):
        first.session.declare_subscriber(key(VELOCITY, "rig0"), velocities.append)
        first.session.declare_subscriber(key(FLOW, "rig0"), lambda s: flows.append(decode(s.payload.to_bytes())))
        deadline_s = time.monotonic() + 60.0
        while not (first.is_up() and second.is_up()) and time.monotonic() < deadline_s:
            first.step()
            second.step()
            time.sleep(0.02)
        assert set(second.process_ids()) == {"flow-0"}
        packets = (p for p in recording.packets() if p.t_ns < 500_000_000)
        with open_session(there.zenoh) as session:
            play(session, "rig0", packets, 1.0, stop)
    assert len(velocities) > 20
    assert len(flows) > 10
    assert sum(f.message.n_selected for f in flows) > 1000
    assert sum(len(f.message.index) for f in flows) == 0


def test_where_nobody_serves_the_error_names_rig_and_endpoint(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("velod.runtime.settings_service.ANSWER_S", 0.3)
    there = Settings(zenoh=ZenohSettings(connect=f"tcp/127.0.0.1:{settings.zenoh.port}"))
    with pytest.raises(NoServiceError, match=f"rig 'rig0' at tcp/127.0.0.1:{settings.zenoh.port}"):
        Supervisor(there, None, ("flow",)).__enter__()


def route(port: int, opened: Event, stop: Event) -> None:
    """A Zenoh router in this process."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        opened.set()
        stop.wait()


def test_all_processes_can_be_clients_of_a_router(slanted: Path, port: int, tmp_path: Path) -> None:
    config = tmp_path / "routed.json5"
    config.write_text(ROUTED.read_text().replace(":7447", f":{port}"))
    settings = Settings(zenoh=ZenohSettings(config=str(config)))
    opened, stop = Event(), Event()
    router = Thread(target=route, args=(port, opened, stop))
    router.start()
    try:
        assert opened.wait(10.0)
        result = run_online(
            settings,
            open_recording(slanted).calibration,
            player_command(str(slanted), settings.zenoh, "rig0", speed=1.0),
            on_line=logging.getLogger("workers").info,
            spare=False,
        )
    finally:
        stop.set()
        router.join()
    assert sum(p.velocity.valid for p in result.velocities) > 300


def test_a_router_that_is_not_there_is_named(port: int, tmp_path: Path) -> None:
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0
    config = tmp_path / "routed.json5"
    config.write_text(ROUTED.read_text().replace(":7447", f":{port}").replace("10000", "300"))
    with pytest.raises(OSError, match="no zenoh session"):
        open_session(ZenohSettings(config=str(config)))
