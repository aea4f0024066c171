"""Names, command lines and restarts of workers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from velod.cli import main
from velod.config import FlowSettings, Settings, ZenohSettings
from velod.runtime import worker
from velod.runtime.kernel_cache import ensure_cache_directory, own_directory
from velod.runtime.process import ChildProcess, stop_all
from velod.runtime.stages import create_stage, stage_of, worker_names
from velod.runtime.supervisor import Supervisor, restart_delay_s
from velod.runtime.warmup import plain_calibration


def test_a_name_tells_the_stage() -> None:
    assert stage_of("flow-12") == "flow"
    for wrong in ("flow", "flow-", "flow-x", "camera-0", ""):
        with pytest.raises(ValueError, match="must be <stage>-<number>"):
            stage_of(wrong)


def test_settings_say_how_many_workers_there_are() -> None:
    settings = Settings(flow=FlowSettings(workers=2))
    assert worker_names(settings, "flow") == ["flow-0", "flow-1"]
    assert worker_names(settings, "ingest") == ["ingest-0"]


def test_a_stage_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="no stage 'camera'"):
        create_stage("camera", Settings(), plain_calibration())


@pytest.mark.parametrize(
    "settings",
    [
        ZenohSettings(port=1234),
        ZenohSettings(connect="tcp/far:1", listen="tcp/10.0.0.1:2", shared_memory=False, lossless=True),
        ZenohSettings(config="zenoh.json5"),
    ],
)
def test_a_worker_s_session_is_that_of_its_service(settings: ZenohSettings) -> None:
    line = worker.worker_arguments(settings, "rig7", "flow-3")
    args = worker.worker_parser("worker", worker="flow-0").parse_args(line)
    assert (args.rig, args.worker, args.parent) == ("rig7", "flow-3", os.getpid())
    expected = replace(
        settings, connect=settings.connect or f"tcp/127.0.0.1:{settings.port}", port=ZenohSettings().port
    )
    assert worker.zenoh_settings(args) == expected


def test_restarts_back_off() -> None:
    assert [restart_delay_s(n) for n in (1, 2, 3, 4)] == [0.0, 0.1, 0.2, 0.4]
    assert restart_delay_s(50) == 10.0


@pytest.mark.parametrize(
    ("stages", "name", "text"),
    [
        (("camera",), "", "unknown stage camera"),
        (("flow", "depth"), "flow-1", "goes with its one stage"),
        (("flow",), "depth-0", "goes with its one stage"),
    ],
)
def test_a_supervisor_refuses_stages_that_are_none(stages: tuple[str, ...], name: str, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Supervisor(Settings(), plain_calibration(), stages, name)


def test_a_supervisor_without_calibration_needs_a_service_to_ask() -> None:
    with pytest.raises(ValueError, match="calibration is needed"):
        Supervisor(Settings(), None)


def ended(code: str) -> str:
    child = ChildProcess([sys.executable, "-c", code], on_line=lambda _: None)
    assert child.wait(10.0)
    why = child.why()
    child.close()
    return why


def test_a_dead_process_says_how_it_ended_and_its_last_words() -> None:
    said = "import sys, os, signal; print('one', file=sys.stderr); print('two', file=sys.stderr); "
    assert ended(said + "sys.exit(3)") == "ended with exit code 3; last lines: one | two"
    assert ended("import os, signal; os.kill(os.getpid(), signal.SIGKILL)") == "killed by SIGKILL"


def test_a_process_that_ignores_sigterm_is_killed() -> None:
    deaf = "import signal, sys, time; signal.signal(15, signal.SIG_IGN); print('deaf', flush=True); time.sleep(60)"
    child = ChildProcess([sys.executable, "-c", deaf], on_line=lambda _: None)
    deadline_s = time.monotonic() + 10.0
    while not child.has_said("deaf") and time.monotonic() < deadline_s:
        time.sleep(0.01)
    stop_all([child], patience_s=0.2)
    assert child.exit_code() == -9


OTHERS_TAKE_THE_SIGNAL = """
import signal, sys, time
from threading import Thread
from velod.runtime.worker import stop_on_signals
Thread(target=time.sleep, args=(60.0,), daemon=True).start()  # as the network's threads are: takes any signal
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGINT})
stop = stop_on_signals()
print("waits", file=sys.stderr, flush=True)
sys.exit(0 if stop.wait(50.0) else 3)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_that_another_thread_takes_ends_the_wait_of_the_main_thread(number: int) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", OTHERS_TAKE_THE_SIGNAL], stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None and process.stderr.readline() == "waits\n"
        process.send_signal(number)
        assert process.wait(20.0) == 0


def test_kernels_are_cached_elsewhere_only_where_nothing_else_can_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    ensure_cache_directory()
    assert "NUMBA_CACHE_DIR" not in os.environ
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    ensure_cache_directory()
    assert os.environ["NUMBA_CACHE_DIR"].endswith(f"velod-numba-{os.getuid()}")


def test_every_command_finds_a_place_for_compiled_kernels_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "to be restored")
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setattr(os, "access", lambda *_: False)  # an installation and a home that are read-only
    assert main(["config", "show"]) == 0
    assert Path(os.environ["NUMBA_CACHE_DIR"]).stat().st_mode & 0o077 == 0


def test_kernels_that_others_could_have_put_there_are_not_taken(tmp_path: Path) -> None:
    own = own_directory(tmp_path)
    assert own_directory(tmp_path) == own
    own.chmod(0o777)
    assert own_directory(tmp_path) != own
    own.rmdir()
    (tmp_path / "elsewhere").mkdir()
    own.symlink_to(tmp_path / "elsewhere")
    assert own_directory(tmp_path) != own
