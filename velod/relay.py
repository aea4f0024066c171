"""Velocities from one network to another, the newest of each rig so often: a client of both sides.

The networks stay apart: nothing but these velocities crosses, neither side learns of the other's routers and rigs,
and a rig's full rate stays where it is.
"""

from __future__ import annotations

import logging
import time
from contextlib import ExitStack
from dataclasses import replace
from threading import Event

import zenoh

from velod.client import Listener, Received
from velod.config import ZenohSettings
from velod.runtime.outlet import Outlet
from velod.runtime.session import open_session
from velod.types import Velocity
from velod.wire import Envelope, encode
from velod.wire.topics import VELOCITY, parts

log = logging.getLogger("velod.relay")

_REPORT_S = 60.0
_POLL_S = 0.1


def relay(source: ZenohSettings, target: ZenohSettings, rig: str, hz: float, stop: Event) -> None:
    """Pass the velocities of ``rig`` (``"*"``: of all) on, each rig's newest ``hz`` times a second, until ``stop`` is
    set. Raises SessionError.
    """
    newest: dict[str, Received] = {}
    with ExitStack() as stack:
        listener = stack.enter_context(Listener(rig, (VELOCITY,), source))
        way_out = _Exit(stack.enter_context(open_session(target)), stack)
        log.info("up")
        next_s, report_s = time.monotonic() + 1.0 / hz, time.monotonic() + _REPORT_S
        while not stop.is_set():
            received = listener.receive(min(_POLL_S, max(0.0, next_s - time.monotonic())))
            if received is not None:
                newest[received.key] = received
            if (now_s := time.monotonic()) >= next_s:
                next_s = max(next_s + 1.0 / hz, now_s)
                for at in sorted(newest):
                    way_out.publish(parts(VELOCITY, at)["rig"], newest[at].envelope)
                newest.clear()
            if now_s >= report_s:
                report_s = now_s + _REPORT_S
                log.info("%s; missed: %s", way_out, listener.counters or "none")


class _Exit:
    """Where velocities leave; what has left is counted by rig."""

    def __init__(self, session: zenoh.Session, stack: ExitStack) -> None:
        """``stack``: closes what is opened meanwhile."""
        self._session, self._stack = session, stack
        self._outlets: dict[str, Outlet] = {}
        self._sent: dict[str, int] = {}

    def publish(self, rig: str, envelope: Envelope) -> None:
        """``seq`` counts anew, so that a receiver sees what is lost on this side; the host times stay as they were,
        and with them ages.
        """
        assert isinstance(envelope.message, Velocity)
        if rig not in self._outlets:
            self._outlets[rig] = self._stack.enter_context(Outlet(self._session, rig))
        seq = self._sent.get(rig, 0)
        self._sent[rig] = seq + 1
        data = encode(replace(envelope.message, seq=seq), envelope.t_pub_ns, envelope.t_origin_ns)
        self._outlets[rig].publish_bytes(VELOCITY, data)

    def __str__(self) -> str:
        return f"{sum(self._sent.values())} velocities of {len(self._sent)} rigs so far"
