"""What outsiders try on a velod at work: nothing passes, nothing dies, and its consumer is served all along."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from velod.prove.attacks import ATTEMPTS, besiege

pytestmark = pytest.mark.system


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_nothing_passes_and_nothing_dies(slanted: Path) -> None:
    siege = besiege(slanted, speed=0.5)
    assert siege.failures() == []
    assert len(siege.outcomes) == len(ATTEMPTS)
    refused = {o.holder: o.happened for o in siege.outcomes if o.attempt == "connect"}
    assert "expired" in refused["consumer, expired"] and "another CA" in refused["consumer of another CA"]
    assert siege.served > 300
