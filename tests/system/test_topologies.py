"""Each shipped topology with real routers and certificates, its hosts being processes of this one."""

from __future__ import annotations

import logging
import math
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from tests.ports import free_ports
from velod.cli import main
from velod.client import Listener, VelocityClient
from velod.config import Settings, ZenohSettings
from velod.io import open_recording
from velod.runtime.certificates import make_keys
from velod.runtime.outlet import Outlet
from velod.runtime.player import play
from velod.runtime.session import SessionError, open_session
from velod.runtime.supervisor import Supervisor
from velod.runtime.topology import PORT, TLS_PORT, Site, write
from velod.types import Velocity
from velod.wire.topics import FLOW, VELOCITY

pytestmark = pytest.mark.system
RIGS = ("drone-1", "drone-2")


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    make_keys(folder, rigs=RIGS)
    return folder


def host(topology: str, site: Site, folder: Path, port: int, tls_port: int) -> Path:
    """The files of a topology for one host, on ports of its own."""
    for path in write(topology, replace(site, host="localhost"), folder):
        text = path.read_text("utf-8").replace(f":{PORT}", f":{port}").replace(f":{TLS_PORT}", f":{tls_port}")
        path.write_text(text.replace("tls/0.0.0.0", "tls/127.0.0.1"), "utf-8")
    return folder


@contextmanager
def router(config: Path) -> Iterator[None]:
    command = [sys.executable, "-P", "-m", "velod.cli", "router", "--zenoh", str(config)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            assert "up" in process.stderr.readline()
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            assert process.wait(10) == 0


@contextmanager
def rig(name: str, config: Path) -> Iterator[Outlet]:
    """What publishes on a rig."""
    with open_session(ZenohSettings(config=str(config))) as session, Outlet(session, name) as outlet:
        yield outlet


def velocity(seq: int, speed: float) -> Velocity:
    return Velocity(seq, seq, np.array([speed, 0.0, 0.0]), np.eye(3), True, "tracking", "", 0, 0)


def test_on_a_robot_with_a_compute_host_workers_join_through_the_router(
    slanted: Path, keys: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = host("robot", Site(keys=str(keys)), tmp_path, *(ports := free_ports(2)))
    recording = open_recording(slanted)
    here = Settings(zenoh=ZenohSettings(config=str(files / "local.json5")))
    there = ZenohSettings(connect=f"tls/localhost:{ports[1]}", keys=str(keys), config=str(files / "compute.json5"))
    log = logging.getLogger("workers").info
    calibration = recording.calibration
    with (
        router(files / "robot-router.json5"),
        Supervisor(here, calibration, ("ingest", "optimizer"), spare=False, on_line=log) as robot,
        Supervisor(Settings(zenoh=there), None, ("flow", "depth"), spare=False, on_line=log) as compute,
        VelocityClient("rig0", f"tls/localhost:{ports[1]}", keys=str(keys), max_age_s=math.inf) as client,
        open_session(here.zenoh) as driver,
    ):
        deadline_s = time.monotonic() + 60.0
        while not (robot.is_up() and compute.is_up()) and time.monotonic() < deadline_s:
            robot.step()
            compute.step()
            time.sleep(0.02)
        assert main(["top", "--once", "--connect", f"tls/localhost:{ports[1]}", "--keys", str(keys)]) == 0
        play(driver, "rig0", (p for p in recording.packets() if p.t_ns < 1_200_000_000), 0.5, Event())
        speeds = [v.v_B[0] for v in iter(lambda: client.receive(0.5), None)]
    table = capsys.readouterr().out
    assert all(worker in table for worker in ("ingest-0", "flow-0", "depth-0", "optimizer-0")), "as operator"
    assert len(speeds) >= 5
    assert np.median(speeds) == pytest.approx(-3.125, abs=0.2)


def test_a_consumer_of_a_fleet_hears_every_rig_by_one_subscription(keys: Path, tmp_path: Path) -> None:
    site = Site(keys=str(keys), rigs=RIGS)
    ports = free_ports(4)
    hub = host("fleet", site, tmp_path / "hub", ports[0], ports[1])
    endpoint = f"tls/localhost:{ports[1]}"
    with ExitStack() as stack:
        stack.enter_context(router(hub / "fleet-router.json5"))
        outlets = []
        for name, port in zip(RIGS, ports[2:], strict=True):
            files = host("fleet", replace(site, keys=str(keys / name)), tmp_path / name, port, ports[1])
            stack.enter_context(router(files / "rig-router.json5"))
            outlets.append(stack.enter_context(rig(name, files / "local.json5")))
        everyone = stack.enter_context(VelocityClient("*", endpoint, keys=str(keys), max_age_s=5.0))
        one = stack.enter_context(VelocityClient("drone-2", endpoint, keys=str(keys / "drone-2"), max_age_s=5.0))
        forger = stack.enter_context(rig("drone-1", tmp_path / "drone-2" / "local.json5"))
        for outlet in outlets:
            assert outlet.wait_for_subscriber(VELOCITY, 10.0)
        for seq in range(5):
            for speed, outlet in enumerate(outlets, start=1):
                outlet.publish(VELOCITY, velocity(seq, speed))
            forger.publish(VELOCITY, velocity(seq, 99.0))  # the second rig, in the first one's name
        heard = [(everyone.rig, v.v_B[0]) for v in iter(lambda: everyone.receive(1.0), None)]
        alone = [(one.rig, v.v_B[0]) for v in iter(lambda: one.receive(0.3), None)]
    assert sorted(heard) == [("drone-1", 1.0)] * 5 + [("drone-2", 2.0)] * 5
    assert alone == [("drone-2", 2.0)] * 5


@pytest.mark.timed
def test_over_a_poor_link_only_velocity_goes_and_no_more_often_than_asked_for(keys: Path, tmp_path: Path) -> None:
    files = host("remote", Site(keys=str(keys), rigs=RIGS, max_hz=10.0), tmp_path, *(ports := free_ports(2)))
    endpoint = f"tls/localhost:{ports[1]}"
    with ExitStack() as stack:
        stack.enter_context(router(files / "remote-router.json5"))
        outlets = [stack.enter_context(rig(name, files / "local.json5")) for name in RIGS]
        far = stack.enter_context(VelocityClient("*", endpoint, keys=str(keys), max_age_s=5.0))
        as_worker = ZenohSettings(connect=endpoint, keys=str(keys), role="worker")
        batches = stack.enter_context(Listener("*", (FLOW, VELOCITY), as_worker))
        assert outlets[0].wait_for_subscriber(VELOCITY, 10.0) and outlets[1].wait_for_subscriber(VELOCITY, 10.0)
        start_s, heard = time.monotonic(), []
        for seq in range(150):
            for outlet in outlets:
                outlet.publish(VELOCITY, velocity(seq, 1.0))
            while (v := far.receive(max(0.0, start_s + (seq + 1) / 75.0 - time.monotonic()))) is not None:
                heard.append((far.rig, v.seq))
        seconds = time.monotonic() - start_s
        assert batches.receive(0.1) is None
    for name in RIGS:
        rate_hz = sum(who == name for who, _ in heard) / seconds
        assert 7.0 <= rate_hz <= 11.0, "10 Hz for each rig"
    assert max(seq for _, seq in heard) >= 140, "the newest"


def test_a_server_that_is_not_there_or_not_to_be_trusted_is_named(keys: Path, tmp_path: Path) -> None:
    files = host("robot", Site(keys=str(keys)), tmp_path / "zenoh", *(ports := free_ports(3))[:2])
    make_keys(tmp_path / "other")
    with pytest.raises(SessionError, match=f"tls/localhost:{ports[2]}.*Connection refused"):
        open_session(ZenohSettings(connect=f"tls/localhost:{ports[2]}", keys=str(keys)))
    with router(files / "robot-router.json5"):
        elsewhere = ZenohSettings(connect=f"tls/localhost:{ports[1]}", keys=str(tmp_path / "other"))
        with pytest.raises(SessionError, match="server's certificate is not to be trusted"):
            open_session(elsewhere)
