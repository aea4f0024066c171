"""What Zenoh has no settings for: how the TCP sockets of its links behave when the other side is lost.

Zenoh asks the kernel to linger: to close a link whose other side has fallen off the network then blocks one of its
threads for 10 s, and with it whatever that thread had to do next for others. Here each link's socket, found among
those of this process as soon as Zenoh reports the link, is told not to. Linux only; elsewhere Zenoh's ways stay.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from queue import SimpleQueue
from threading import Thread
from typing import Final

import zenoh

from velod.runtime.callbacks import direct

log = logging.getLogger("velod")

RETRANSMIT_MIN_US: Final = 20_000
"""After the round trip, how long at least until a segment is sent again. The kernel's 200 ms would keep a velocity,
and all those behind it, for longer than it is of use; its other means need later segments to arrive first."""

_TCP_RTO_MIN_US: Final = 45  # linux/tcp.h since 6.15; Python has no name for it
_NO_LINGER: Final = struct.pack("ii", 0, 0)
_FILES: Final = "/proc/self/fd"
_LOCATOR = re.compile(r"(?:tcp|tls)/\[?(?P<host>[^\]]+?)\]?:(?P<port>\d+)(?:[?#].*)?")


def keep_from_blocking(session: zenoh.Session) -> None:
    """Set the options of all TCP links of ``session``, those to come included, as long as it is open."""
    if sys.platform != "linux":
        return

    def changed(event: zenoh.LinkEvent) -> None:
        if event.kind == zenoh.SampleKind.PUT:
            set_options(event.link.src, event.link.dst)

    follow(session, changed, history=True)


def follow(session: zenoh.Session, changed: Callable[[zenoh.LinkEvent], None], *, history: bool = False) -> None:
    """Call ``changed`` for every link that comes or goes as long as ``session`` is open; with ``history`` also for
    those that are there.

    In a thread of its own, one for all sessions: Zenoh reports links from a thread that receives for others, which
    would wait for as long as Python takes, 0.1 s where the interpreter is busy.
    """
    _start_thread()

    def note(event: zenoh.LinkEvent) -> None:
        _to_do.put((changed, event))

    session.info.declare_link_events_listener(direct(note), history=history)


_to_do: SimpleQueue[tuple[Callable[[zenoh.LinkEvent], None], zenoh.LinkEvent]] = SimpleQueue()


@cache
def _start_thread() -> None:
    Thread(target=_do_it, name="links", daemon=True).start()


def _do_it() -> None:
    while True:
        changed, event = _to_do.get()
        try:
            changed(event)
        except Exception:  # of one link; those to come are looked after all the same
            log.exception("a link that has changed")


def set_options(src: str, dst: str) -> int:
    """Set the options of this process's socket from locator ``src`` to ``dst``; returns how many there are."""
    found = 0
    for link in _sockets_between(src, dst):
        link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
        with suppress(OSError):  # an older kernel
            link.setsockopt(socket.IPPROTO_TCP, _TCP_RTO_MIN_US, RETRANSMIT_MIN_US)
        found += 1
    return found


def cut(session: zenoh.Session, peer: str) -> None:
    """End the TCP links of ``session`` to ``peer`` (its id), as if the network had: Zenoh makes those anew that it
    was configured to have. Does nothing where Linux's ways are missing.
    """
    if sys.platform != "linux":
        return
    for link in session.info.links():
        if str(link.zid) == peer:
            for end in _sockets_between(link.src, link.dst):
                with suppress(OSError):  # ended by itself
                    end.shutdown(socket.SHUT_RDWR)


def _sockets_between(src: str, dst: str) -> Iterator[socket.socket]:
    """A duplicate of this process's socket from locator ``src`` to ``dst``, open for one round of a loop."""
    ends = (_address(src), _address(dst))
    if None in ends:
        return  # a link of another kind
    for link in _tcp_sockets():
        with link:
            if ends == _ends(link):
                yield link
                return


def _address(locator: str) -> tuple[str, int] | None:
    match = _LOCATOR.fullmatch(locator)
    return (match["host"], int(match["port"])) if match is not None else None


def _ends(link: socket.socket) -> tuple[tuple[str, int], tuple[str, int]] | None:
    try:
        return link.getsockname()[:2], link.getpeername()[:2]
    except OSError:
        return None  # not connected


def _tcp_sockets() -> Iterator[socket.socket]:
    """Duplicates of this process's TCP sockets, to be closed."""
    for name in sorted(os.listdir(_FILES), key=int, reverse=True):  # a link that is looked for is a new one
        try:
            if not os.readlink(f"{_FILES}/{name}").startswith("socket:"):
                continue
            descriptor = os.dup(int(name))
        except OSError:
            continue  # closed a moment ago
        duplicate = socket.socket(fileno=descriptor)
        if duplicate.family in (socket.AF_INET, socket.AF_INET6) and duplicate.type == socket.SOCK_STREAM:
            yield duplicate
        else:
            duplicate.close()
