"""A warm spare: a process with everything loaded that waits to be told which dead worker it replaces.

It reads one line of JSON from stdin, ``{"become": "flow-0"}``. A fresh process would need seconds to import and to
load kernels; the spare is at work in a fraction of one. What it loads, it loads in threads of low priority (Linux
keeps a niceness per thread), so as not to slow the workers; the main thread, which will be a worker, only waits.
For the same reason this module imports the standard library and next to nothing of velod at first.

A stage's further workers start in the same way, beside those that work already: told with ``--worker`` at once.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from threading import Event
from typing import TYPE_CHECKING, TypeVar

from velod.runtime.kernel_cache import ensure_cache_directory
from velod.runtime.parent import die_with

if TYPE_CHECKING:
    from velod.config import Settings
    from velod.geometry.calibration import Calibration
    from velod.runtime.stages import Stage

READY = "ready"
_NICENESS, _WANTED_NICENESS = 19, 10
"""Of what waits to be needed; of what is."""
_POLL_S = 0.1

T = TypeVar("T")


def main(argv: Sequence[str] | None = None) -> int:
    """Wait, then be a worker; returns the exit code."""
    known = _first_look(argv)
    with suppress(OSError):  # it is said later, with a log
        die_with(known.parent)
    niceness = _WANTED_NICENESS if known.worker else _NICENESS
    quietly(_import_all, niceness)
    from velod.runtime import worker
    from velod.runtime.custody import identity
    from velod.runtime.session import open_session
    from velod.runtime.settings_service import fetch
    from velod.runtime.stages import stage_of

    parser = worker.worker_parser("python -P -m velod.runtime.spare", worker="")
    parser.add_argument("--stages", required=True, help="which stages it is to stand by for, a,b,c")
    args = parser.parse_args(argv)
    try:
        worker.prepare_process(args.parent)
        stop = worker.stop_on_signals()
        with open_session(worker.zenoh_settings(args)) as session:
            settings, calibration = fetch(session, args.rig, args.connect)
            stages = quietly(lambda: _load(settings, calibration, args.stages.split(",")), niceness)
            print(READY, flush=True)
            name = args.worker or _wait_for_order(stop)
            if name:
                worker.start_logging(name)
                worker.enter_custody(args, name, identity(settings, calibration), stop)
                worker.serve_stage(session, settings, name, stages[stage_of(name)], stop)
    except (OSError, ValueError) as e:
        worker.log.error("%s", e)
        return worker.EXIT_USAGE
    return 0


def _first_look(argv: Sequence[str] | None) -> argparse.Namespace:
    """Whom to die with, from now on: what follows may take seconds; and whether it is to be a worker at once."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--parent", type=int, default=0)
    parser.add_argument("--worker", default="")
    return parser.parse_known_args(argv)[0]


def quietly(work: Callable[[], T], niceness: int = _NICENESS) -> T:
    """The result of ``work``, done in a thread of low priority. Raises what it raised."""
    results: list[T] = []
    failures: list[BaseException] = []

    def run() -> None:
        if sys.platform == "linux":
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
        try:
            results.append(work())
        except BaseException as e:
            failures.append(e)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if failures:
        raise failures[0]
    return results[0]


def _import_all() -> None:
    from velod.runtime import stages, worker

    worker.start_logging("spare")
    ensure_cache_directory()
    stages.import_all()


def _load(settings: Settings, calibration: Calibration, names: Sequence[str]) -> dict[str, Stage]:
    """Stages ready for their first message: kernels loaded, tables made."""
    from velod.runtime import stages, warmup

    for name in names:
        warmup.warm_up(name, settings, calibration)
    return {name: stages.create_stage(name, settings, calibration) for name in names}


def _wait_for_order(stop: Event) -> str:
    """The worker to become; empty when told to stop, or when the supervisor is gone."""
    while not stop.is_set():
        if select.select([sys.stdin], [], [], _POLL_S)[0]:
            line = sys.stdin.readline()
            return str(json.loads(line)["become"]) if line else ""
    return ""


if __name__ == "__main__":
    sys.exit(main())
