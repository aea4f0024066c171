"""kill -9, SIGTERM, SIGSTOP, garbage: what happens to real processes, and that the service lives."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.system.rig import Stalls
from velod import config
from velod.client import VelocityClient
from velod.config import FlowSettings, RigSettings, Settings, ZenohSettings
from velod.geometry.calibration_files import save_calibration
from velod.io import open_recording
from velod.runtime.online import OnlineResult, run_online
from velod.runtime.player import player_command
from velod.runtime.session import SessionError, open_session
from velod.runtime.stages import STAGES
from velod.runtime.supervisor import Supervisor
from velod.types import DepthBatch, FlowBatch, Message
from velod.wire import encode
from velod.wire.topics import BATCH_DEPTH, BATCH_FLOW, DEPTH, EVENTS, FLOW, IMU, IMU_SENSOR, key

pytestmark = pytest.mark.system


class Disturbance:
    """Does something once, so long after the first velocity."""

    def __init__(self, result_has_begun: list[float], after_s: float) -> None:
        self.begun, self.after_s = result_has_begun, after_s
        self.done = False

    def is_due(self) -> bool:
        due = not self.done and bool(self.begun) and time.monotonic() - self.begun[0] > self.after_s
        self.done |= due
        return due


def longest_gap_s(result: OnlineResult) -> float:
    """Between two valid velocities as they were published, from the first valid one on."""
    t = np.array([p.t_pub_ns for p in result.velocities if p.velocity.valid])
    return float(np.diff(t).max() * 1e-9)


POOL_KIB = 65536


def locked_kib(pid: int) -> int:
    """Memory locked for a process: Zenoh's shared memory, its own and that of others."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmLck:")[2].split()[0])


def kill_during_replay(
    settings: Settings, recording: Path, worker: str, locked: list[int] | None = None
) -> tuple[OnlineResult, dict[str, set[int]], list[str]]:
    """``locked`` takes the optimizer's locked memory from the death on, KiB."""
    begun: list[float] = []
    kill = Disturbance(begun, after_s=2.0)
    seqs: dict[str, set[int]] = {"FlowBatch": set(), "DepthBatch": set()}

    def on_message(message: Message) -> None:
        if isinstance(message, FlowBatch | DepthBatch):
            seqs[type(message).__name__].add(message.seq)

    def on_step(supervisor: Supervisor) -> None:
        due = kill.is_due()
        if locked is not None and kill.done:
            locked.append(locked_kib(supervisor.process_ids()["optimizer-0"]))
        if due:
            os.kill(supervisor.process_ids()[worker], signal.SIGKILL)

    lines: list[str] = []
    result = run_online(
        settings,
        open_recording(recording).calibration,
        player_command(str(recording), settings.zenoh, settings.rig.name),
        on_velocity=lambda _: None if begun else begun.append(time.monotonic()),
        on_message=on_message,
        topics=(FLOW, DEPTH),
        on_step=on_step,
        on_line=lines.append,
    )
    assert kill.done
    return result, seqs, lines


def lost(seqs: set[int]) -> int:
    return max(seqs) + 1 - len(seqs)


def assert_reported(result: OnlineResult, worker: str, log: pytest.LogCaptureFixture) -> None:
    assert result.restarts[worker] == 1
    assert sum(result.restarts.values()) == 1
    supervisor = result.health["supervisor"]
    assert supervisor.counters == {f"restarts.{worker}": 1}
    assert "killed by SIGKILL" in supervisor.alarms[worker]
    assert any(worker in r.getMessage() and "killed by SIGKILL" in r.getMessage() for r in log.records)


@pytest.mark.timed
@pytest.mark.parametrize("worker", ["flow-0", "depth-0"])
def test_killing_a_flow_or_depth_worker_loses_no_batch_and_leaves_no_gap(
    slanted: Path, settings: Settings, worker: str, caplog: pytest.LogCaptureFixture
) -> None:
    locked: list[int] | None = [] if sys.platform == "linux" else None
    result, seqs, _ = kill_during_replay(settings, slanted, worker, locked)
    assert_reported(result, worker, caplog)
    if locked:  # a pool of shared memory is 64 MiB: ingest's and the driver's, and none that a dead worker left
        assert max(locked) < 3 * POOL_KIB
    assert lost(seqs["FlowBatch"]) == lost(seqs["DepthBatch"]) == 0
    assert longest_gap_s(result) <= 0.1
    assert result.gaps == 0


@pytest.mark.timed
@pytest.mark.parametrize("worker", ["ingest-0", "optimizer-0"])
def test_after_the_death_of_ingest_or_the_optimizer_velocity_is_back_within_a_second(
    slanted: Path, settings: Settings, worker: str, caplog: pytest.LogCaptureFixture
) -> None:
    result, _, _ = kill_during_replay(settings, slanted, worker)
    assert_reported(result, worker, caplog)
    assert longest_gap_s(result) <= 1.0
    if worker == "ingest-0":  # the IMU came straight from the sensor meanwhile: no hole that ends the estimate
        assert not {"imu.gap_restart", "clock.restart"} & set(result.health["optimizer-0"].counters)
    last = [p.velocity for p in result.velocities][-50:]
    assert all(v.valid for v in last)
    assert np.median([np.linalg.norm(v.v_B - [-3.125, 0.0, 0.0]) for v in last]) < 0.1


@pytest.mark.timed
def test_garbage_and_alien_versions_are_counted_and_the_service_goes_on(slanted: Path, settings: Settings) -> None:
    begun: list[float] = []
    disturb = Disturbance(begun, after_s=1.0)
    rig = settings.rig.name
    flow = FlowBatch(
        0, 1, 0, *(np.zeros(0, t) for t in (np.uint16, np.uint32, np.float32, np.float32)),
        np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32),
    )  # fmt: skip
    alien = encode(flow, 0).replace(b"\xa1v\x01", b"\xa1v\x63")
    assert b"\xa1v\x63" in alien
    targets = [
        key(EVENTS, rig, camera="left"),
        key(IMU_SENSOR, rig),
        key(BATCH_FLOW, rig, worker="flow-0"),
        key(BATCH_DEPTH, rig, worker="depth-0"),
        key(FLOW, rig),
        key(IMU, rig),
    ]

    def on_step(supervisor: Supervisor) -> None:
        if disturb.is_due():
            for target in targets:
                for data in (b"", b"\xff garbage", alien):
                    supervisor.session.put(target, data)

    result = run_online(
        settings,
        open_recording(slanted).calibration,
        player_command(str(slanted), settings.zenoh, rig),
        on_velocity=lambda _: None if begun else begun.append(time.monotonic()),
        on_step=on_step,
        on_line=logging.getLogger("workers").info,
        spare=False,
    )
    assert disturb.done
    refused = {
        worker: sum(n for name, n in health.counters.items() if name.startswith("wire."))
        for worker, health in result.health.items()
    }
    assert refused == {
        "ingest-0": 6, "flow-0": 3, "depth-0": 3, "optimizer-0": 6, "player-0": 0, "supervisor": 0,
    }  # fmt: skip
    assert result.health["optimizer-0"].counters["wire.version_alien"] == 2
    assert sum(result.restarts.values()) == 0
    assert longest_gap_s(result) <= 0.1


@pytest.mark.timed
def test_a_worker_that_hangs_is_passed_over_and_loses_no_batch(slanted: Path, settings: Settings) -> None:
    two = replace(settings, flow=FlowSettings(workers=2))
    begun: list[float] = []
    hang, wake = Disturbance(begun, after_s=1.0), Disturbance(begun, after_s=3.5)
    seqs: set[int] = set()

    def on_step(supervisor: Supervisor) -> None:
        pid = supervisor.process_ids()["flow-0"]
        if hang.is_due():
            os.kill(pid, signal.SIGSTOP)
        if wake.is_due():
            os.kill(pid, signal.SIGCONT)

    result = run_online(
        two,
        open_recording(slanted).calibration,
        player_command(str(slanted), two.zenoh, two.rig.name),
        on_velocity=lambda _: None if begun else begun.append(time.monotonic()),
        on_message=lambda m: seqs.add(m.seq),
        topics=(FLOW,),
        on_step=on_step,
        on_line=logging.getLogger("workers").info,
        spare=False,
    )
    assert hang.done
    assert wake.done
    assert lost(seqs) == 0
    assert longest_gap_s(result) <= 0.1
    # whether its time was up first, or its lease
    counters = result.health["ingest-0"].counters
    assert counters.get("dispatch.expired.flow", 0) + counters.get("dispatch.resent.flow", 0) >= 1


CONSUMER = """
import sys, time
from velod.config import ZenohSettings
from velod.runtime.session import open_session
with open_session(ZenohSettings(port=int(sys.argv[1]))) as session:
    subscriber = session.declare_subscriber("velod/**")
    time.sleep(0.5)
    print("listening", flush=True)
    time.sleep(600)
"""


@pytest.mark.timed
def test_a_stopped_consumer_disturbs_nobody(slanted: Path, settings: Settings) -> None:
    begun: list[float] = []
    stop_it = Disturbance(begun, after_s=1.0)
    consumers: list[subprocess.Popen[bytes]] = []

    def on_step(supervisor: Supervisor) -> None:
        if not consumers:
            command = [sys.executable, "-c", CONSUMER, str(settings.zenoh.port)]
            consumers.append(subprocess.Popen(command, stdout=subprocess.DEVNULL))
        if stop_it.is_due():
            os.kill(consumers[0].pid, signal.SIGSTOP)

    try:
        result = run_online(
            settings,
            open_recording(slanted).calibration,
            player_command(str(slanted), settings.zenoh, settings.rig.name),
            on_velocity=lambda _: None if begun else begun.append(time.monotonic()),
            on_step=on_step,
            on_line=logging.getLogger("workers").info,
            spare=False,
        )
    finally:
        for consumer in consumers:
            consumer.kill()
            consumer.wait()
    assert stop_it.done
    assert result.gaps == 0
    assert longest_gap_s(result) <= 0.1


SERVICE = """
import sys
from velod.config import FlowSettings, Settings, ZenohSettings
from velod.runtime.supervisor import Supervisor
from velod.runtime.warmup import plain_calibration
from velod.runtime.worker import stop_on_signals
stop = stop_on_signals()
with Supervisor(Settings(zenoh=ZenohSettings(port=int(sys.argv[1]))), plain_calibration()) as supervisor:
    supervisor.run(stop)
"""


def start_service(port: int) -> tuple[subprocess.Popen[str], set[int]]:
    """The service as its own process, once all of its workers and the spare are there; and their process ids."""
    service = subprocess.Popen(
        [sys.executable, "-c", SERVICE, str(port)], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )
    assert service.stderr is not None
    up = 0
    for line in service.stderr:
        up += line.count("INFO up")  # two lines may come as one
        if up >= len(STAGES):
            break
    time.sleep(1.0)
    return service, children_of(service.pid)


def children_of(pid: int) -> set[int]:
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return {int(child) for child in text.split()}


def is_running(pid: int) -> bool:
    """Whether there is such a process; one that has ended stays until whoever inherited it has looked at it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def are_gone(pids: set[int], within_s: float) -> bool:
    deadline_s = time.monotonic() + within_s
    while time.monotonic() < deadline_s:
        if not any(map(is_running, pids)):
            return True
        time.sleep(0.05)
    return False


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_a_supervisor_that_ends_leaves_no_process(port: int, number: signal.Signals) -> None:
    service, children = start_service(port)
    assert len(children) == len(STAGES) + 1
    service.send_signal(number)
    _, log = service.communicate(timeout=10.0)
    assert are_gone(children, within_s=2.0)
    assert service.returncode == (-signal.SIGKILL if number == signal.SIGKILL else 0)
    assert "Traceback" not in log


def velod_run(stack: ExitStack, folder: Path, port: int, recording: Path, name: str) -> subprocess.Popen[bytes]:
    """``velod run`` as a user has it; its log is ``name`` in the folder."""
    rig, settings = folder / "rig.yaml", folder / "velod.toml"
    save_calibration(rig, open_recording(recording).calibration)
    service = Settings(rig=RigSettings("rig0", str(rig)), zenoh=ZenohSettings(port=port))
    settings.write_text(config.to_toml(service), "utf-8")
    command = [sys.executable, "-P", "-m", "velod.cli", "run", "-c", str(settings)]
    return started(stack, command, folder / name)


def started(stack: ExitStack, command: list[str], log: Path) -> subprocess.Popen[bytes]:
    """A process that does not outlive the test."""
    with log.open("w") as file:
        process = subprocess.Popen(command, stderr=file)
    stack.callback(process.wait)
    stack.callback(process.terminate)
    return process


def wait_for_lines(log: Path, text: str, times: int, within_s: float = 60.0) -> None:
    deadline_s = time.monotonic() + within_s
    while log.read_text().count(text) < times:
        assert time.monotonic() < deadline_s, f"not {times} times {text!r}:\n{log.read_text()}"
        time.sleep(0.05)


@pytest.mark.timed
@pytest.mark.skipif(sys.platform != "linux", reason="workers outlive their supervisor on Linux alone")
def test_a_supervisor_that_is_killed_and_started_again_costs_no_velocity(
    slanted: Path, port: int, tmp_path: Path
) -> None:
    """Its workers go on, and are the next one's; that one ends them in good order.

    To start all anew takes 2.6 s at the least. Here a supervisor and a spare load beside work that goes on.
    """
    zenoh, heard_s, ticks_ns = ZenohSettings(port=port), [], []
    player = [*player_command(str(slanted), zenoh, "rig0"), "--repeat", "inf"]
    with ExitStack() as stack:
        first = velod_run(stack, tmp_path, port, slanted, "first")
        wait_for_lines(tmp_path / "first", "INFO up", len(STAGES))
        wait_for_lines(tmp_path / "first", "spare is ready", 1)
        workers = children_of(first.pid)
        started(stack, player, tmp_path / "player")
        stalls = stack.enter_context(Stalls())
        client = stack.enter_context(VelocityClient("rig0", f"tcp/127.0.0.1:{port}"))
        while len(heard_s) < 450:
            velocity = client.receive(10.0)
            assert velocity is not None
            heard_s.append(time.monotonic())
            ticks_ns.append(velocity.t_ns)
            if len(heard_s) == 100:
                first.kill()
            if len(heard_s) == 150:
                second = velod_run(stack, tmp_path, port, slanted, "second")
    log = (tmp_path / "second").read_text()
    assert log.count("left at work by another supervisor, goes on") == log.count("INFO up") == len(STAGES)
    assert not any("process" in line and "started" in line for line in log.splitlines())
    assert np.diff(heard_s).max() <= 0.3 + 2.0 * stalls.longest_s
    assert np.diff(ticks_ns).max() <= 0.3e9 + 2e9 * stalls.longest_s
    assert second.returncode == 0
    assert are_gone(workers, within_s=1.0)
    assert "Traceback" not in log


def test_a_port_in_use_gives_one_line_that_names_it(port: int) -> None:
    settings = ZenohSettings(port=port)
    with (
        open_session(settings, introducer=True),
        pytest.raises(SessionError, match=f"^port {port} is already in use") as caught,
    ):
        open_session(settings, introducer=True)
    assert "\n" not in str(caught.value)
