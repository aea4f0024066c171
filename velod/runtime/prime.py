"""Making a session's shared memory before it is needed.

Zenoh makes the pool of a session at its first large message, and a receiver attaches to it then: up to 0.2 s during
which a process stands still, and with it the first batches of a run. So those that will send large messages, driver
and ingest, send one at their start, which is taken and ignored by those that will take such messages, and by nobody
else: whoever takes one holds the pool. Ingest sends one more to greet a new worker.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import zenoh

from velod.runtime import pools
from velod.runtime.callbacks import direct
from velod.runtime.outlet import Outlet
from velod.wire.topics import PRIME, key

log = logging.getLogger("velod")

LARGE = 262_144
"""Bytes; far above the size from which messages go through shared memory."""
WAIT_S = 1.0


def listen(session: zenoh.Session, rig: str) -> Any:
    """Take what ``prime`` sends; returns the subscriber, to be kept."""

    def ignore(sample: zenoh.Sample) -> None:
        del sample

    return session.declare_subscriber(key(PRIME, rig), direct(ignore))


@contextmanager
def prime(session: zenoh.Session, rig: str) -> Iterator[None]:
    """Send one large message where somebody takes it, and own the memory that this made while the context lasts.

    Without a taker go on after WAIT_S.
    """
    begun_ns = time.time_ns()
    with Outlet(session, rig) as outlet:
        if outlet.wait_for_subscriber(PRIME, WAIT_S):
            outlet.publish_bytes(PRIME, bytes(LARGE))
        else:
            log.debug("nobody takes %s: the first large message will be slow", key(PRIME, rig))
    with pools.owned(begun_ns):
        yield
