"""Links between peers that were lost while both live: Zenoh does not make them anew, so velod has it do so.

Peers hear of each other from the introducer, once, and then link. Whoever was stopped or cut off for about as long
as a lease finds some of its links given up and others not: those who gave one up had heard of it up to a keep-alive
earlier. If the link to the introducer is among those that stayed, nobody tells the two of each other again, and what
they have to say goes nowhere until one of them is started anew. So whoever loses a link asks the introducer whether
the other is still there, and if so lets go of the introducer: Zenoh links to it again at once (in 5 ms), and both
hear of each other. Linux only, as ``links`` is.
"""

from __future__ import annotations

import json
import logging
import time
from contextlib import suppress
from threading import Lock, Thread
from typing import Final

import zenoh

from velod.runtime.links import cut, follow
from velod.wire.topics import LINKED

log = logging.getLogger("velod")

WAIT_S: Final = 0.6
"""Longer than a keep-alive (0.5 s): so long the introducer may list one that has fallen silent for all."""
TRIES: Final = 8
ANSWER_S: Final = 1.0


def tell_of_links(session: zenoh.Session) -> None:
    """The introducer's part: answer, as long as ``session`` is open, with whom it is linked."""

    def asked(query: zenoh.Query) -> None:
        with query:
            query.reply(LINKED, json.dumps([str(session.info.zid()), *_linked(session)]))

    session.declare_queryable(LINKED, asked)


def keep_linked(session: zenoh.Session) -> None:
    """The part of everybody else, as long as ``session`` is open."""
    relinker = _Relinker(session)

    def changed(event: zenoh.LinkEvent) -> None:
        if event.kind == zenoh.SampleKind.DELETE:
            relinker.lost(str(event.link.zid))

    follow(session, changed)


class _Relinker:
    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._me = str(session.info.zid())
        self._tries: dict[str, int] = {}  # so far, by the peer that was lost
        self._lock = Lock()
        self._looks = False

    def lost(self, peer: str) -> None:
        """The link to ``peer`` has ended."""
        with self._lock:
            self._tries[peer] = 0
            if not self._looks:
                self._looks = True
                Thread(target=self._look_after_them, name="relink", daemon=True).start()

    def _look_after_them(self) -> None:
        while self._looks:
            time.sleep(WAIT_S)
            with self._lock:
                self._tries = {peer: n + 1 for peer, n in self._tries.items()}
            # Without the lock, for which one of the network's threads may wait.
            linked: set[str] = set()
            introducers: dict[str, set[str]] = {}
            with suppress(zenoh.ZError, RuntimeError):  # closed, or being closed
                linked, introducers = _linked(self._session), _introducers(self._session)
            missing = self._still_lost(linked, introducers)
            for introducer, peers in introducers.items():
                if missing & peers:
                    log.info("no link to a process that is there: the introducer is asked again")
                    cut(self._session, introducer)

    def _still_lost(self, linked: set[str], introducers: dict[str, set[str]]) -> set[str]:
        """Peers for which something is to be done now; those that are back, or gone, are forgotten."""
        there = {peer for peers in introducers.values() for peer in peers}
        with self._lock:
            self._tries = {
                peer: n
                for peer, n in self._tries.items()
                # 0: lost again since ``linked`` was looked up
                if n == 0 or (n <= TRIES and peer not in linked and (peer in there or not introducers))
            }
            self._looks = bool(self._tries)
            # One of the two is enough, at first.
            return {peer for peer, n in self._tries.items() if n > 1 or peer < self._me}


def _linked(session: zenoh.Session) -> set[str]:
    return {str(peer) for peer in session.info.peers_zid()}


def _introducers(session: zenoh.Session) -> dict[str, set[str]]:
    """Whom each introducer that answers is linked with."""
    known = {}
    for reply in session.get(LINKED, timeout=ANSWER_S):
        if reply.ok is not None:
            introducer, *peers = json.loads(reply.ok.payload.to_string())
            known[introducer] = set(peers)
    return known
