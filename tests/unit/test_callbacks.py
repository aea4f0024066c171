"""Python functions that the network's threads call."""

from __future__ import annotations

import threading
import time

import zenoh

from velod.config import ZenohSettings
from velod.runtime.callbacks import direct
from velod.runtime.session import introducer_endpoint, open_session

MESSAGES = 50
WAIT_S = 5.0


def test_a_thread_of_the_network_stays_known_between_calls(session: zenoh.Session, port: int) -> None:
    """What a thread keeps for itself is there in its next call, as it would not be were it forgotten in between."""
    known, calls, strangers = threading.local(), [], []

    def arrived(sample: zenoh.Sample) -> None:
        calls.append(sample.payload.to_bytes())
        if not hasattr(known, "yes"):
            known.yes = True
            strangers.append(threading.get_native_id())

    other = ZenohSettings(connect=introducer_endpoint(ZenohSettings(port=port)))
    with open_session(other) as sender, session.declare_subscriber("callbacks", direct(arrived)):
        publisher = sender.declare_publisher("callbacks")
        deadline_s = time.monotonic() + WAIT_S
        while len(calls) < MESSAGES and time.monotonic() < deadline_s:
            publisher.put(b"message")
            time.sleep(0.002)
    assert len(calls) >= MESSAGES
    assert len(strangers) == len(set(strangers)) > 0
