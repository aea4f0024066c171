"""Peers that lose each other while both live, and stay linked to their introducer, find each other again."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from velod.config import ZenohSettings
from velod.prove.besieged import free_port
from velod.runtime import links, relink
from velod.runtime.certificates import make_keys
from velod.runtime.session import open_session

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="finds its sockets in /proc")

Three = tuple[zenoh.Session, zenoh.Session, zenoh.Session]


def id_of(session: zenoh.Session) -> str:
    return str(session.info.zid())


def are_linked(a: zenoh.Session, b: zenoh.Session) -> bool:
    return id_of(b) in relink._linked(a) and id_of(a) in relink._linked(b)


def wait_until(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    deadline_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline_s, "in vain"
        time.sleep(0.01)


@pytest.fixture(params=[False, True], ids=["on one host", "open to others by TLS"])
def three(port: int, request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Three]:
    """An introducer and two others, all linked; its list of what is allowed must let them ask."""
    settings = guarded = ZenohSettings(port=port)
    if request.param:
        make_keys(tmp_path)
        guarded = replace(settings, listen=f"tls/127.0.0.1:{free_port()}", keys=str(tmp_path))
    with (
        open_session(guarded, introducer=True) as introducer,
        open_session(settings) as a,
        open_session(settings) as b,
    ):
        wait_until(lambda: are_linked(a, b) and are_linked(a, introducer) and are_linked(b, introducer))
        yield introducer, a, b


def test_messages_pass_again_after_a_link_was_lost(three: Three) -> None:
    _, a, b = three
    came: list[float] = []
    with b.declare_subscriber("any/key", lambda sample: came.append(time.monotonic())):
        links.cut(a, id_of(b))
        wait_until(lambda: not are_linked(a, b))
        lost_s = time.monotonic()

        def passes() -> bool:
            a.put("any/key", b"")
            return bool(came)

        wait_until(passes)
    # Not by itself, and after two looks at the most (a busy machine may need a third).
    assert relink.WAIT_S * 0.5 < came[0] - lost_s < 4 * relink.WAIT_S
    assert are_linked(a, b)


def test_nobody_leaves_the_introducer_when_another_ends(three: Three) -> None:
    introducer, a, b = three
    lost: list[str] = []

    def changed(event: zenoh.LinkEvent) -> None:
        if event.kind == zenoh.SampleKind.DELETE:
            lost.append(str(event.link.zid))

    a.info.declare_link_events_listener(zenoh.handlers.Callback(changed, indirect=False))
    ended = id_of(b)
    b.close()
    wait_until(lambda: ended in lost)
    time.sleep(2.5 * relink.WAIT_S)
    assert lost == [ended]
    assert are_linked(a, introducer)
