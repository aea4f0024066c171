"""What the sockets of Zenoh's links are told besides what Zenoh tells them."""

from __future__ import annotations

import socket
import struct
import sys
import time

import pytest

from velod.config import ZenohSettings
from velod.runtime import links
from velod.runtime.session import open_session

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="finds its sockets in /proc")


@pytest.fixture
def pair() -> tuple[socket.socket, socket.socket]:
    """Both ends of one TCP connection on loopback, with a lingering close as Zenoh asks for."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far = server.accept()[0]
    near.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))
    return near, far


def lingers(link: socket.socket) -> bool:
    return struct.unpack("ii", link.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))[0] != 0


def locator(address: tuple[str, int]) -> str:
    return f"tcp/{address[0]}:{address[1]}"


def test_the_socket_of_a_link_is_found_by_its_ends_and_no_longer_lingers(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    near, far = pair
    with near, far:
        assert lingers(near)
        assert links.set_options(locator(near.getsockname()), "tcp/127.0.0.1:1") == 0
        assert lingers(near)
        assert links.set_options(locator(near.getsockname()), f"{locator(near.getpeername())}?rel=1#iface=lo") == 1
        assert not lingers(near)


def test_links_of_other_kinds_are_left_alone() -> None:
    assert links.set_options("unixsock-stream//tmp/a", "unixsock-stream//tmp/b") == 0


@pytest.mark.parametrize("locator_", ["tcp/127.0.0.1:7", "tls/127.0.0.1:7#iface=lo", "tcp/127.0.0.1:7?rel=1"])
def test_a_locator_s_address_is_read_whatever_follows_it(locator_: str) -> None:
    assert links._address(locator_) == ("127.0.0.1", 7)
    assert links._address("tcp/[fe80::1]:7") == ("fe80::1", 7)


def test_no_link_of_a_session_lingers_whether_it_was_made_or_taken() -> None:
    """Both ends are in this process; Zenoh gives each of them 10 s."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with open_session(ZenohSettings(port=port), introducer=True) as first, open_session(ZenohSettings(port=port)):
        deadline_s = time.monotonic() + 10.0
        while (n := sum(link.src != "" for link in first.info.links())) == 0 or lingering(port):
            assert time.monotonic() < deadline_s, f"{n} links, {lingering(port)} sockets linger"
            time.sleep(0.02)


def lingering(port: int) -> int:
    """Connections of this process from or to a port that linger."""
    n = 0
    for link in links._tcp_sockets():
        with link:
            ends = links._ends(link)
            n += ends is not None and port in (ends[0][1], ends[1][1]) and lingers(link)
    return n
