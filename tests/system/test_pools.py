"""Shared memory that a dead sender left behind is given back, and that of the living is not touched."""

from __future__ import annotations

import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import pytest

from velod.config import ZenohSettings
from velod.runtime import pools
from velod.runtime.pools import POOL_BYTES, PoolKeeper
from velod.runtime.session import open_session
from velod.wire.topics import PRIME, key

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(sys.platform != "linux", reason="finds shared memory in /proc"),
]

SENDER = """
import sys, time
from velod.config import ZenohSettings
from velod.runtime.prime import prime
from velod.runtime.session import open_session
with open_session(ZenohSettings(port=int(sys.argv[1]))) as session:
    {how}
        print("up", flush=True)
        while True:
            session.put("velod/rig0/prime", bytes([7]) * 262_144)
            time.sleep(0.02)
"""
OWNING = 'with prime(session, "rig0"):'
NOT_OWNING = "if True:"  # a driver that is not velod's


@pytest.fixture
def receiver(port: int) -> Iterator[deque[bytes]]:
    """Takes large messages in this process, and keeps the newest."""
    newest: deque[bytes] = deque(maxlen=1)
    with (
        open_session(ZenohSettings(port=port), introducer=True) as session,
        session.declare_subscriber(key(PRIME, "rig0"), lambda sample: newest.append(sample.payload.to_bytes())),
    ):
        yield newest


def send(port: int, how: str = OWNING) -> subprocess.Popen[str]:
    """A process whose pool is mapped here from now on."""
    wanted = mapped_bytes() + POOL_BYTES
    sender = subprocess.Popen(
        [sys.executable, "-c", SENDER.format(how=how), str(port)], stdout=subprocess.PIPE, text=True
    )
    assert sender.stdout is not None
    assert sender.stdout.readline() == "up\n"
    deadline_s = time.monotonic() + 5.0
    while mapped_bytes() < wanted:
        assert time.monotonic() < deadline_s, "its pool is not mapped here"
        time.sleep(0.01)
    return sender


def mapped_bytes() -> int:
    """Shared memory that is resident in this process, by Linux' own account."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("RssShmem:")[2].split()[0]) << 10


@pytest.mark.usefixtures("receiver")
def test_the_pool_of_a_dead_sender_is_given_back_and_that_of_a_living_one_stays(port: int) -> None:
    keeper = PoolKeeper()
    before = mapped_bytes()
    dead, living = send(port), send(port)
    try:
        now_s = time.monotonic()
        assert keeper.look(now_s) == 0
        assert mapped_bytes() - before >= 2 * POOL_BYTES
        dead.kill()
        dead.wait()
        assert keeper.look(now_s + pools.GRACE_S - 0.1) == 0, "what came last may be under way still"
        assert keeper.look(now_s + pools.GRACE_S) == 1
        assert POOL_BYTES <= mapped_bytes() - before < 1.2 * POOL_BYTES
        assert keeper.look(now_s + 100.0) == 0
        assert mapped_bytes() - before >= POOL_BYTES
    finally:
        for sender in (dead, living):
            sender.kill()
            sender.wait()


def test_who_has_no_use_for_a_pool_holds_none_of_it_and_reads_what_comes_all_the_same(
    port: int, receiver: deque[bytes]
) -> None:
    """A new link carries everything until its ends have told each other what they want: any process may map one."""
    keeper = PoolKeeper(takes_large=False)
    before = mapped_bytes()
    sender = send(port)
    try:
        assert mapped_bytes() - before >= POOL_BYTES
        assert keeper.look(0.0) == 0
        assert mapped_bytes() - before < 0.1 * POOL_BYTES
        receiver.clear()
        deadline_s = time.monotonic() + 5.0
        while not receiver:
            assert time.monotonic() < deadline_s, "nothing comes any more"
            time.sleep(0.01)
        assert set(receiver.pop()) == {7}
    finally:
        sender.kill()
        sender.wait()


@pytest.mark.usefixtures("receiver")
def test_a_pool_that_nobody_locked_is_left_alone(port: int) -> None:
    keeper = PoolKeeper()
    sender = send(port, NOT_OWNING)
    before = mapped_bytes()
    keeper.look(0.0)
    sender.kill()
    sender.wait()
    assert keeper.look(100.0) == 0
    assert before - mapped_bytes() < 0.2 * POOL_BYTES
