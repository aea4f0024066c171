"""Sequences judged side by side: what fails is named and takes nothing else with it; what is kept fits the code."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from velod.cli.cases import SequenceJob
from velod.cli.exit import RunFailed
from velod.cli.jobs import code_fingerprint, commit, run_jobs
from velod.config import Settings


def test_a_job_that_fails_is_named_with_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VELOD_CACHE_DIR", str(tmp_path))
    job = SequenceJob("nowhere-1", Settings(), 0.1, 1, None, (1,), 1.0, 1, draw=False)
    with pytest.raises(RunFailed, match="nowhere-1: unknown sequence 'nowhere-1'; known: corridor-1"):
        run_jobs([job], processes=1)
    assert not list(tmp_path.rglob("*.pickle"))


def gone(group: int, within_s: float) -> bool:
    """Whether the last process of a group ends in time."""
    deadline_s = time.monotonic() + within_s
    while time.monotonic() < deadline_s:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


def test_no_process_is_left_when_a_table_is_interrupted(tmp_path: Path) -> None:
    environment = {**os.environ, "VELOD_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-P", "-m", "velod.cli", "eval", "--table", "held-out", "--jobs", "1"]
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True) as run:
        # The first recording is being written: a job of minutes is under way.
        deadline_s = time.monotonic() + 60.0
        while not list(tmp_path.rglob("*.part*")) and time.monotonic() < deadline_s:
            time.sleep(0.1)
        run.send_signal(signal.SIGTERM)
        _, err = run.communicate(timeout=60.0)
    assert run.returncode == 130
    assert err == "velod: interrupted\n"
    assert gone(run.pid, within_s=10.0)
    assert not list(tmp_path.rglob("*.part*"))


def test_the_fingerprint_is_that_of_the_code() -> None:
    assert code_fingerprint() == code_fingerprint()
    assert len(code_fingerprint()) == 64


def test_a_checkout_has_a_commit() -> None:
    assert commit() == "no checkout" or commit().rstrip("+").isalnum()
