"""A flow worker with an artificial work load, a process: ``ENDPOINT NAME MS``; each batch takes so much longer.

It sleeps instead of computing, so that more workers are more capacity even where there are not more cores.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

from velod.config import ZenohSettings
from velod.runtime import worker
from velod.runtime.session import open_session
from velod.runtime.settings_service import fetch
from velod.runtime.stages import Stage, create_stage
from velod.runtime.warmup import warm_up
from velod.types import Message


class Slow:
    """A stage that takes its time."""

    def __init__(self, stage: Stage, sleep_s: float) -> None:
        self._stage, self._sleep_s = stage, sleep_s

    @property
    def counters(self) -> Mapping[str, int]:
        """Of the stage."""
        return self._stage.counters

    def handle(self, message: Any) -> Sequence[Message]:
        """What the stage makes of it, later."""
        time.sleep(self._sleep_s)
        return self._stage.handle(message)


def main() -> None:
    """A flow worker that sleeps on each batch: arguments ENDPOINT NAME MS."""
    endpoint, name, ms = sys.argv[1:]
    worker.start_logging(name)
    worker.prepare_process(0)
    stop = worker.stop_on_signals()
    with open_session(ZenohSettings(connect=endpoint, insecure=True)) as session:
        settings, calibration = fetch(session, "rig0", endpoint)
        warm_up("flow", settings, calibration)
        stage = Slow(create_stage("flow", settings, calibration), float(ms) * 1e-3)
        worker.serve_stage(session, settings, name, stage, stop)


if __name__ == "__main__":
    main()
