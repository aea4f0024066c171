"""The first large message of a process is not the one that makes its shared memory."""

from __future__ import annotations

from threading import Event

import pytest

from velod.config import ZenohSettings
from velod.runtime import prime
from velod.runtime.session import open_session
from velod.wire.topics import PRIME, key

pytestmark = pytest.mark.system


def test_the_priming_message_is_large_and_arrives_where_it_is_listened_to(port: int) -> None:
    settings = ZenohSettings(port=port)
    arrived, sizes = Event(), []
    with open_session(settings, introducer=True) as supervisor, open_session(settings) as worker:

        def take(sample) -> None:
            sizes.append(len(sample.payload.to_bytes()))
            arrived.set()

        kept = supervisor.declare_subscriber(key(PRIME, "rig0"), take)
        with prime.prime(worker, "rig0"):
            assert arrived.wait(5.0)
        kept.undeclare()
    assert sizes == [prime.LARGE]


def test_without_a_listener_a_process_starts_all_the_same(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prime, "WAIT_S", 0.1)
    with open_session(ZenohSettings(port=port), introducer=True) as session:
        with prime.prime(session, "rig0"):
            pass
        with prime.listen(session, "rig0"), prime.prime(session, "rig0"):
            pass
