"""A warm spare: a process with everything loaded that waits to be told which dead worker it replaces.

It reads one line of JSON from stdin, ``{"become": "flow-0"}``. A fresh process would need seconds to import and to
load kernels; the spare is at work in a fraction of one.
"""

from __future__ import annotations

import json
import logging
import os
import select
import sys
import threading
from collections.abc import Sequence
from threading import Event

from velod.config import Settings
from velod.geometry.calibration import Calibration
from velod.runtime.session import open_session
from velod.runtime.settings_service import fetch
from velod.runtime.stages import STAGES, Stage, stage_of
from velod.runtime.worker import (
    EXIT_USAGE,
    load_stages,
    prepare_process,
    serve_stage,
    start_logging,
    stop_on_signals,
    worker_parser,
    zenoh_settings,
)

READY = "ready"
_NICENESS = 15
_POLL_S = 0.1

log = logging.getLogger("velod")


def main(argv: Sequence[str] | None = None) -> int:
    """Wait, then be a worker; returns the exit code."""
    parser = worker_parser("python -P -m velod.runtime.spare", worker="")
    parser.add_argument("--stages", default=",".join(STAGES), help="which stages it is to stand by for")
    args = parser.parse_args(argv)
    start_logging("spare")
    try:
        prepare_process(args.parent)
        stop = stop_on_signals()
        with open_session(zenoh_settings(args)) as session:
            settings, calibration = fetch(session, args.rig, args.connect)
            stages = _load_in_background(settings, calibration, args.stages.split(","))
            print(READY, flush=True)
            worker = _wait_for_order(stop)
            if worker:
                start_logging(worker)
                serve_stage(session, settings, worker, stages[stage_of(worker)], stop)
    except (OSError, ValueError) as e:
        log.error("%s", e)
        return EXIT_USAGE
    return 0


def _load_in_background(settings: Settings, calibration: Calibration, names: Sequence[str]) -> dict[str, Stage]:
    """Load stages in a thread of low priority, so as not to slow the workers that are busy.

    Raises whatever loading raised.
    """
    loaded: dict[str, Stage] = {}
    failure: list[Exception] = []

    def load() -> None:
        # Linux keeps a niceness per thread: the main thread, which will be a worker, stays as it is.
        if sys.platform == "linux":
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        try:
            loaded.update(load_stages(settings, calibration, names))
        except Exception as e:
            failure.append(e)

    thread = threading.Thread(target=load)
    thread.start()
    thread.join()
    if failure:
        raise failure[0]
    return loaded


def _wait_for_order(stop: Event) -> str:
    """The worker to become; empty when told to stop, or when the supervisor is gone."""
    while not stop.is_set():
        if select.select([sys.stdin], [], [], _POLL_S)[0]:
            line = sys.stdin.readline()
            return str(json.loads(line)["become"]) if line else ""
    return ""


if __name__ == "__main__":
    sys.exit(main())
