"""Sequences judged side by side in processes, each outcome kept on disk: a run that was cut short goes on.

What was kept is used only for equal settings, seeds and lengths, and for the very code that made it.
"""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
import pickle
import signal
import subprocess
import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING, Any

import velod
from velod.cli.cases import Outcome, SequenceJob
from velod.cli.exit import RunFailed, raise_if_interrupted
from velod.cli.line import Line

if TYPE_CHECKING:
    from multiprocessing.synchronize import Event

_LOOK_S = 0.2


def run_jobs(jobs: Sequence[SequenceJob], processes: int) -> list[Outcome]:
    """The outcome of every job, in their order. Raises RunFailed where one failed, after the others are kept."""
    context = multiprocessing.get_context("spawn")
    notes, stop = context.Queue(), context.Event()
    line, outcomes, failed, code = _Progress(len(jobs)), {}, [], code_fingerprint()
    pool = ProcessPoolExecutor(processes, context, _begin, (notes, stop))
    try:
        waiting: dict[Future[Outcome], SequenceJob] = {pool.submit(_kept_or_run, job, code): job for job in jobs}
        while waiting:
            raise_if_interrupted()
            done, _ = wait(waiting, timeout=_LOOK_S, return_when=FIRST_COMPLETED)
            while not notes.empty():
                line.note(*notes.get())
            line.draw()
            for future in done:
                job = waiting.pop(future)
                try:
                    outcomes[job.name] = future.result()
                    line.finished(job.name)
                except (ValueError, OSError, RuntimeError, BrokenProcessPool) as e:
                    failed.append(f"{job.name}: {e or type(e).__name__}")
    finally:
        # The jobs look at it now and then: nobody has to wait for a job of minutes.
        stop.set()
        pool.shutdown(cancel_futures=True)
        line.finish()
    if failed:
        raise RunFailed("; ".join(failed) + " (the others are kept: run it again)")
    return [outcomes[job.name] for job in jobs]


def code_fingerprint() -> str:
    """Of every line of velod's code."""
    digest = hashlib.sha256()
    root = Path(velod.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def commit() -> str:
    """The checkout's commit, with a ``+`` where it has been changed since; "no checkout" for an installed velod."""
    root = Path(velod.__file__).parent
    try:
        found = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty=+", "--exclude=*"],
            capture_output=True, text=True, check=True, timeout=10.0,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return "no checkout"
    return found.stdout.strip()


_in_worker: tuple[Any, Event] | None = None


def _begin(notes: Any, stop: Event) -> None:
    """In each process: Ctrl-C is the parent's business."""
    global _in_worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _in_worker = notes, stop


def _kept_or_run(job: SequenceJob, code: str) -> Outcome:
    path = _place(job, code)
    try:
        with path.open("rb") as file:
            kept: Outcome = pickle.load(file)
        return kept
    except (OSError, EOFError, pickle.UnpicklingError):
        pass  # not done yet, or cut short
    outcome = job.run(_Teller(job.name))
    part = path.with_name(f"{path.name}.part{os.getpid()}")
    part.write_bytes(pickle.dumps(outcome))
    part.replace(path)
    return outcome


def _place(job: SequenceJob, code: str) -> Path:
    from velod.sim.driver import MODEL_VERSION, cache_directory

    digest = hashlib.sha256(repr((MODEL_VERSION, code, job)).encode()).hexdigest()
    directory = cache_directory().parent / "eval"
    directory.mkdir(parents=True, exist_ok=True)
    return directory / f"{job.name}-{digest[:16]}.pickle"


class _Teller:
    """Passes on what a job is doing, a few times a second, and ends it when it is to stop."""

    def __init__(self, name: str) -> None:
        assert _in_worker is not None, "_begin has run"
        self._notes, self._stop = _in_worker
        self._name, self._next_s = name, 0.0

    def __call__(self, what: str, share: float) -> None:
        if time.monotonic() < self._next_s and math.isfinite(share):
            return
        self._next_s = time.monotonic() + _LOOK_S
        if self._stop.is_set():
            raise RuntimeError("stopped")
        self._notes.put((self._name, what, share))


class _Progress:
    """One line on a terminal: how many are done, and what the others are doing."""

    def __init__(self, count: int) -> None:
        self._count, self._done = count, 0
        self._line = Line()
        self._doing: dict[str, tuple[str, float]] = {}
        self._begin_s = time.monotonic()

    def note(self, name: str, what: str, share: float) -> None:
        self._doing[name] = what, share

    def finished(self, name: str) -> None:
        self._done += 1
        self._doing.pop(name, None)
        self._line.log(f"{name}: done, {self._done} of {self._count}, {time.monotonic() - self._begin_s:.0f} s")

    def draw(self) -> None:
        if not self._line.due():
            return
        parts = [
            f"{name}: {what}" + (f" {100.0 * share:.0f} %" if math.isfinite(share) else "")
            for name, (what, share) in self._doing.items()
        ]
        self._line.draw(f"{self._done}/{self._count}  " + "  ".join(parts))

    def finish(self) -> None:
        self._line.finish()
