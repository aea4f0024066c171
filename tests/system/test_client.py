"""The client against a publisher over real Zenoh, in this process, on a port of its own."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.ports import free_ports
from velod.cli import main
from velod.client import VelocityClient
from velod.config import ZenohSettings
from velod.runtime.outlet import Outlet
from velod.runtime.session import SessionError, open_session
from velod.types import Velocity
from velod.wire import encode
from velod.wire.topics import VELOCITY

pytestmark = pytest.mark.system
EXAMPLES = Path(__file__).parents[2] / "examples"


def velocity(seq: int, valid: bool = True) -> Velocity:
    state = "tracking" if valid else "lost"
    return Velocity(seq, seq, np.array([1.0, 2.0, 3.0]), 1e-4 * np.eye(3), valid, state, "", 0, 0)


@dataclass
class Service:
    """A publisher of velocities that is the introducer on its port."""

    port: int
    outlet: Outlet

    @property
    def endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    def publish(self, seq: int, age_s: float = 0.0, valid: bool = True, age_ms: float = 0.0) -> None:
        message = replace(velocity(seq, valid), age_ms=age_ms)
        data = encode(message, time.time_ns() - int(age_s * 1e9))
        self.outlet.publish_bytes(VELOCITY, data)


def start(stack: ExitStack, port: int) -> Service:
    session = stack.enter_context(open_session(ZenohSettings(port=port), introducer=True))
    return Service(port, stack.enter_context(Outlet(session, "rig0")))


@pytest.fixture
def service() -> Iterator[Service]:
    with ExitStack() as stack:
        yield start(stack, free_ports(1)[0])


def heard(service: Service) -> None:
    assert service.outlet.wait_for_subscriber(VELOCITY, 5.0)


def test_velocities_arrive_in_order_and_as_they_were_sent(service: Service) -> None:
    with VelocityClient("rig0", connect=service.endpoint, max_age_s=5.0) as client:
        heard(service)
        for seq in range(5):
            service.publish(seq)
        received = [client.receive(5.0) for _ in range(5)]
    assert [v.seq for v in received if v is not None] == [0, 1, 2, 3, 4]
    assert received[0] is not None and received[0].v_B.tolist() == [1.0, 2.0, 3.0]
    assert client.counters == {}


def test_what_is_stale_invalid_lost_or_garbage_is_counted_and_not_handed_out(service: Service) -> None:
    with VelocityClient("rig0", connect=service.endpoint, max_age_s=1.0) as client:
        heard(service)
        service.publish(0, age_s=2.0)
        service.publish(1, valid=False)
        service.outlet.publish_bytes(VELOCITY, b"garbage")
        service.outlet.publish_bytes(VELOCITY, encode(velocity(2), time.time_ns())[:-3])
        service.publish(5)
        received = client.receive(5.0)
    assert received is not None and received.seq == 5
    counters = client.counters
    assert (counters["stale"], counters["invalid"], counters["gap.velocity"]) == (1, 1, 3)
    assert counters["wire.truncated"] == 1 and sum(n for name, n in counters.items() if "wire." in name) == 2


def test_the_age_runs_from_the_sensor_s_time_and_what_was_old_when_it_was_published_is_stale(
    service: Service,
) -> None:
    with VelocityClient("rig0", connect=service.endpoint, max_age_s=1.0) as client:
        heard(service)
        service.publish(0, age_ms=1500.0)
        service.publish(1, age_ms=30.0)
        received = client.receive(5.0)
    assert received is not None and received.seq == 1
    assert 30.0 < received.age_ms < 1000.0
    assert client.counters == {"stale": 1}


def test_a_publisher_whose_clock_is_ahead_makes_the_age_unknown_and_that_is_said(service: Service) -> None:
    with VelocityClient("rig0", connect=service.endpoint, max_age_s=1.0) as client:
        heard(service)
        service.publish(0, age_s=-0.5)
        service.publish(1)
        first, second = client.receive(5.0), client.receive(5.0)
    assert first is not None and second is not None
    assert math.isnan(first.age_ms) and math.isnan(second.age_ms)
    assert client.counters == {"age.unknown": 2}


def test_what_was_handed_out_once_is_not_handed_out_again(service: Service) -> None:
    with VelocityClient("rig0", connect=service.endpoint, max_age_s=5.0) as client:
        heard(service)
        for seq in (0, 1, 1, 0, 2):
            service.publish(seq)
        received = [client.receive(5.0) for _ in range(3)]
    assert [v.seq for v in received if v is not None] == [0, 1, 2]
    assert client.counters["repeated"] == 2


def test_all_velocities_are_handed_out_when_asked_for(service: Service) -> None:
    with VelocityClient("rig0", connect=service.endpoint, max_age_s=math.inf, valid_only=False) as client:
        heard(service)
        service.publish(0, age_s=100.0, valid=False)
        received = client.receive(5.0)
    assert received is not None and not received.valid


def test_a_slow_consumer_gets_the_newest_and_knows_what_it_missed(service: Service) -> None:
    with VelocityClient("rig0", connect=service.endpoint, max_age_s=math.inf) as client:
        heard(service)
        for seq in range(100):
            service.publish(seq)
        deadline_s = time.monotonic() + 5.0
        while client.counters.get("inbox.overflow.velocity", 0) < 92 and time.monotonic() < deadline_s:
            time.sleep(0.01)
        received = client.receive(1.0)
        assert received is not None and received.seq == 92
        assert client.counters["inbox.overflow.velocity"] == 92


def test_silence_ends_a_receive_with_a_timeout(service: Service) -> None:
    with VelocityClient("rig0", connect=service.endpoint) as client:
        start_s = time.monotonic()
        assert client.receive(0.3) is None
    assert 0.25 < time.monotonic() - start_s < 2.0


def test_the_client_may_come_first_and_survives_a_restart_of_the_service() -> None:
    port = free_ports(1)[0]
    with VelocityClient("rig0", connect=f"tcp/127.0.0.1:{port}", max_age_s=5.0) as client:
        assert client.receive(0.2) is None
        for expected in (7, 8):
            with ExitStack() as stack:
                first = start(stack, port)
                heard(first)
                first.publish(expected)
                received = client.receive(10.0)
                assert received is not None and received.seq == expected


def test_a_malformed_endpoint_is_one_clear_error() -> None:
    with pytest.raises(SessionError, match="must be an endpoint such as tcp/"), VelocityClient(connect="rig:17447"):
        pass


def test_the_consumer_that_knows_nothing_of_velod_prints_velocities(service: Service) -> None:
    command = [sys.executable, str(EXAMPLES / "consumer.py"), service.endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as consumer:
        try:
            assert service.outlet.wait_for_subscriber(VELOCITY, 10.0)
            service.publish(1, valid=False)
            service.publish(2)
            assert consumer.stdout is not None
            assert consumer.stdout.readline().split() == ["2", "+1.000±0.010", "+2.000±0.010", "+3.000±0.010"]
        finally:
            consumer.kill()


def test_echo_prints_velocities_and_top_shows_who_lost_what(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    # The flood of messages outlives the start of the command; each command takes one.
    publisher = subprocess.Popen([sys.executable, "-c", _FLOOD, service.endpoint], stdout=subprocess.PIPE)
    try:
        assert main(["echo", "--connect", service.endpoint, "-n", "2", "--timeout", "20"]) == 0
        assert capsys.readouterr().out.count("|v|  3.742 ± 0.010 m/s") == 2
        assert main(["top", "--once", "--connect", service.endpoint]) == 0
        table = capsys.readouterr().out
    finally:
        publisher.kill()
        publisher.communicate()
    assert "flow-0        gone" in table and "events.backwards: 3" in table and "ALARM stale: no batch" in table


_FLOOD = """
import sys, time, numpy as np
from velod.config import ZenohSettings
from velod.runtime.outlet import Outlet
from velod.runtime.session import open_session
from velod.types import Health, Velocity
from velod.wire.topics import HEALTH, VELOCITY
with open_session(ZenohSettings(connect=sys.argv[1])) as session, Outlet(session, "rig0") as outlet:
    for seq in range(10_000):
        outlet.publish(VELOCITY, Velocity(
            seq, seq, np.array([1.0, 2.0, 3.0]), 1e-4 * np.eye(3), True, "tracking", "", 0, 0))
        outlet.publish(HEALTH, Health(seq, 0, "flow", "flow-0", 1, "h", "0", 1.0,
            {"events.backwards": 3}, {}, {}, {"stale": "no batch"}), worker="flow-0")
        time.sleep(0.02)
"""


def test_echo_of_a_silent_topic_gives_up_and_says_so(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["echo", "health", "--connect", service.endpoint, "--timeout", "0.3"]) == 1
    said = capsys.readouterr().err
    assert "no health of rig rig0 in 0.3 s" in said and said.endswith("no process of that rig is there\n")


def test_top_says_that_nobody_is_there(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["top", "--once", "--connect", service.endpoint]) == 1
    assert "nobody there" in capsys.readouterr().out
