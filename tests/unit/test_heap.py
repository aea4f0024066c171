"""Memory that was freed is told apart from what is in use."""

from __future__ import annotations

import subprocess
import sys

import pytest

from velod.runtime.health import HealthReporter
from velod.runtime.heap import KEPT, heap_gauges

FREES = """
from velod.runtime.heap import KEPT, heap_gauges, keep_memory
keep_memory()
messages = [bytes(100_000) for _ in range(300)]
held = heap_gauges()[KEPT]
del messages
print(heap_gauges()[KEPT] - held)
"""

pytestmark = pytest.mark.skipif(not heap_gauges(), reason="the C library does not tell")


def test_what_a_burst_of_messages_leaves_behind_is_kept_and_free() -> None:
    done = subprocess.run([sys.executable, "-c", FREES], capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(300 * 100_000 / 2**20, abs=3.0)


def test_every_process_says_so_in_its_health() -> None:
    gauges = HealthReporter("flow", "flow-0").report(0, {}, {}, gauges={"share.events": 1.0}).gauges
    assert gauges.keys() == {"share.events", KEPT}
