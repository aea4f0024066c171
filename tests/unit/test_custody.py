"""A worker whose supervisor is killed works on, is taken over by the next one, or ends; and there are never two."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from velod.config import FlowSettings, Settings
from velod.runtime.adoption import adopt
from velod.runtime.custody import Place, identity
from velod.runtime.process import AdoptedProcess
from velod.runtime.warmup import plain_calibration

pytestmark = [
    pytest.mark.timed,
    pytest.mark.skipif(
        sys.platform != "linux", reason="custody is a matter of Linux' sockets and files of processes"
    ),
]

WORKER = """
import logging, sys
from threading import Event
from velod.runtime.custody import Place, live_in_custody
from velod.runtime.parent import die_with
logging.basicConfig(level=logging.INFO)
endpoint, parent, wait_s = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
die_with(parent)
stop = Event()
try:
    live_in_custody(Place(endpoint, "rig0"), "flow-0", parent, wait_s, b"what it works with", stop)
    print("at work", flush=True)
    stop.wait(60.0)
except OSError as e:
    print(e, flush=True)
"""
SUPERVISOR = """
import os, subprocess, sys, time
worker = subprocess.Popen([sys.executable, "-c", sys.argv[1], sys.argv[2], str(os.getpid()), sys.argv[3]])
print(worker.pid, flush=True)
time.sleep(60.0)
"""
WAIT_S = 1.0


@dataclass
class Service:
    """One worker and its supervisor, who can be killed."""

    place: Place
    supervisors: list[subprocess.Popen[str]] = field(default_factory=list)
    workers: list[int] = field(default_factory=list)

    def start(self) -> str:
        """Start one more supervisor with its worker; what that says."""
        arguments = [sys.executable, "-c", SUPERVISOR, WORKER, self.place.endpoint, str(WAIT_S)]
        supervisor = subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True)
        self.supervisors.append(supervisor)
        assert supervisor.stdout is not None
        said = sorted(supervisor.stdout.readline().strip() for _ in range(2))  # both write there
        self.workers.append(int(said[0]))
        return said[1]

    def kill_supervisor(self) -> int:
        """kill -9; the process of its worker."""
        self.supervisors[-1].kill()
        self.supervisors[-1].wait()
        return self.workers[-1]


@pytest.fixture
def service(port: int) -> Iterator[Service]:
    started = Service(Place(f"tcp/127.0.0.1:{port}", "rig0"))
    yield started
    for supervisor in started.supervisors:
        supervisor.kill()
        supervisor.communicate()
    for worker in started.workers:
        if is_there(worker):
            os.kill(worker, signal.SIGKILL)


def is_there(pid: int) -> bool:
    """Whether a process runs, or is stopped: one that nobody has waited for is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def is_gone(pid: int, within_s: float) -> bool:
    deadline_s = time.monotonic() + within_s
    while is_there(pid) and time.monotonic() < deadline_s:
        time.sleep(0.01)
    return not is_there(pid)


def taken_over(service: Service, who: bytes = b"what it works with", wanted: str = "flow-0") -> list[AdoptedProcess]:
    lines: list[str] = []
    return list(adopt(service.place, {wanted}, who, lines.append).values())


def test_nobody_comes_and_the_worker_ends_by_itself(service: Service) -> None:
    assert service.start() == "at work"
    worker = service.kill_supervisor()
    time.sleep(0.5 * WAIT_S)
    assert is_there(worker)
    assert is_gone(worker, within_s=2.0 * WAIT_S)


def test_a_stopped_worker_ends_as_well(service: Service) -> None:
    assert service.start() == "at work"
    os.kill(service.workers[-1], signal.SIGSTOP)
    assert is_gone(service.kill_supervisor(), within_s=3.0 * WAIT_S)


def test_the_next_supervisor_takes_it_over_for_as_long_as_it_lives_itself(service: Service) -> None:
    service.start()
    worker = service.kill_supervisor()
    lines: list[str] = []
    adopted = adopt(service.place, {"flow-0"}, b"what it works with", lines.append)["flow-0"]
    assert adopted.pid == worker
    assert not is_gone(worker, within_s=1.5 * WAIT_S)
    assert adopted.exit_code() is None
    assert any("with another supervisor" in line for line in lines), "its log goes there now"
    adopted.close()
    assert is_gone(worker, within_s=2.5 * WAIT_S)


def test_one_that_was_taken_over_is_ended_as_a_child_is(service: Service) -> None:
    service.start()
    service.kill_supervisor()
    (adopted,) = taken_over(service)
    adopted.terminate()
    assert adopted.wait(2.0)
    assert "ended, a process of another supervisor's before" in adopted.why()
    adopted.close()


@pytest.mark.parametrize(
    ("who", "wanted"), [(b"other settings", "flow-0"), (b"what it works with", "flow-1")], ids=["settings", "name"]
)
def test_one_that_works_with_something_else_or_that_nobody_wants_is_ended(
    service: Service, who: bytes, wanted: str
) -> None:
    service.start()
    worker = service.kill_supervisor()
    assert taken_over(service, who, wanted) == []
    assert not is_there(worker)


def test_there_is_no_second_worker_of_the_name(service: Service) -> None:
    assert service.start() == "at work"
    assert service.start() == "another process is flow-0 of this service already"


def test_what_a_worker_works_with_is_told_apart_by_settings_and_calibration_alone() -> None:
    settings, calibration = Settings(), plain_calibration()
    assert identity(settings, calibration) == identity(Settings(), plain_calibration())
    assert identity(settings, calibration) != identity(Settings(flow=FlowSettings(workers=2)), calibration)
