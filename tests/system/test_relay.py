"""``velod relay`` between two routers with certificates of different authorities."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from tests.system.test_topologies import free_ports, velocity
from velod.cli import main
from velod.client import Listener
from velod.config import ZenohSettings
from velod.runtime.certificates import make_keys
from velod.runtime.outlet import Outlet
from velod.runtime.session import open_session
from velod.types import Health
from velod.wire.topics import HEALTH, VELOCITY, parts

pytestmark = pytest.mark.system
RIGS = ("drone-1", "drone-2")
HZ = 5.0


@contextmanager
def velod(*arguments: str) -> Iterator[None]:
    """A velod command that says ``up`` and ends well on SIGTERM."""
    command = [sys.executable, "-P", "-m", "velod.cli", *arguments]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as p:
        try:
            assert p.stderr is not None
            assert "up" in (said := p.stderr.readline()), said
            yield
        finally:
            p.send_signal(signal.SIGTERM)
            assert p.wait(10) == 0


def health(seq: int) -> Health:
    return Health(seq, seq, "flow", "flow-0", 1, "host", "0", 1.0)


@pytest.mark.timed
def test_the_newest_velocity_of_each_rig_goes_up_so_often_and_nothing_else_does(tmp_path: Path) -> None:
    ports = free_ports(4)
    site, top = (f"tls/localhost:{port}" for port in ports[2:])
    keys = {name: tmp_path / name for name in ("site", "top")}
    with ExitStack() as stack:
        for folder, port, tls_port in zip(keys.values(), ports[:2], ports[2:], strict=True):
            make_keys(folder)
            listens = ["--port", str(port), "--listen", f"tls/127.0.0.1:{tls_port}", "--keys", str(folder)]
            stack.enter_context(velod("router", *listens))
        way = ["--connect", site, "--keys", str(keys["site"]), "--to", top, "--to-keys", str(keys["top"])]
        stack.enter_context(velod("relay", *way, "--hz", f"{HZ:g}"))
        session = stack.enter_context(
            open_session(ZenohSettings(connect=site, keys=str(keys["site"]), role="worker"))
        )
        outlets = [stack.enter_context(Outlet(session, rig)) for rig in RIGS]
        operator = ZenohSettings(connect=top, keys=str(keys["top"]), role="operator")
        above = stack.enter_context(Listener("*", (VELOCITY, HEALTH), operator))
        assert all(outlet.wait_for_subscriber(VELOCITY, 10.0) for outlet in outlets)
        start_s, heard = time.monotonic(), []
        for seq in range(150):
            for outlet in outlets:
                outlet.publish(VELOCITY, velocity(seq, 1.0))
                outlet.publish(HEALTH, health(seq), worker="flow-0")
            while (received := above.receive(max(0.0, start_s + (seq + 1) / 75.0 - time.monotonic()))) is not None:
                heard.append(received)
        seconds = time.monotonic() - start_s
        assert above.counters == {}
    assert {received.topic for received in heard} == {VELOCITY}
    for rig in RIGS:
        of_rig = [received.envelope.message for received in heard if parts(VELOCITY, received.key)["rig"] == rig]
        assert [v.seq for v in of_rig] == list(range(len(of_rig)))
        assert 0.7 * HZ * seconds <= len(of_rig) <= HZ * seconds + 1
        assert np.diff([v.t_ns for v in of_rig]).min() > 0 and of_rig[-1].t_ns >= 120
    assert np.median([received.age_s for received in heard]) < 0.1, "the newest, with the time at which it was made"


@pytest.mark.parametrize("hz", ["0", "-1", "inf", "nan"])
def test_a_rate_that_is_none_is_refused(hz: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["relay", "--to", "tcp/127.0.0.1:1", "--hz", hz])
    assert "--hz: must be positive and finite" in capsys.readouterr().err
