"""What one hop between two processes costs: velod beside raw Zenoh and a plain Unix socket, in the same run.

``measure`` sends the same bytes by each way to a process of this module, which notes when it has them: raw as bytes,
velod's as a checked message in the hands of a stage. Raw Zenoh goes through the same sessions with the same settings.
The ways take turns in runs of messages, because a stage handles one kind all the time, 100 to 500 a second: each
message by another way would find the code of its own gone from the caches. Both processes are on one host, so one
clock serves.
"""

from __future__ import annotations

import json
import logging
import socket
import struct
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from threading import Event, Thread
from typing import Any, ClassVar

import numpy as np
import zenoh

from velod.config import Settings, ZenohSettings
from velod.runtime.callbacks import direct
from velod.runtime.heap import keep_memory
from velod.runtime.outlet import Outlet
from velod.runtime.process import ChildProcess, stop_all
from velod.runtime.session import introducer_endpoint, open_session
from velod.runtime.shell import WorkerShell
from velod.runtime.worker import prepare_process
from velod.types import EventPacket, Message
from velod.wire import Envelope, encode
from velod.wire.topics import EVENTS, Topic

WAYS = ("velod", "zenoh", "socket")
_RAW_KEY = "hop/raw"
_PAUSE_S = 0.005  # between two messages, so that none waits for another
_RUN = 20  # messages by one way, then as many by the next; the first run of each does not count
_READY, _TOOK = "ready", "took "
_LENGTH, _TIME = struct.Struct("<I"), struct.Struct("<q")


def measure(packet: EventPacket, n: int, port: int) -> dict[str, float]:
    """Median time of one hop of ``packet`` by each of WAYS, us, over ``n`` messages each. Raises TimeoutError."""
    settings = ZenohSettings(port=port)
    took: list[dict[str, list[int]]] = []
    keep_memory()  # as a worker does

    def on_line(line: str) -> None:
        if line.startswith(_TOOK):
            took.append(json.loads(line.removeprefix(_TOOK)))

    with ExitStack() as stack:
        directory = stack.enter_context(tempfile.TemporaryDirectory())
        listener = stack.enter_context(socket.socket(socket.AF_UNIX))
        listener.bind(path := str(Path(directory) / "hop"))
        listener.listen()
        listener.settimeout(60.0)
        session = stack.enter_context(open_session(settings, introducer=True))
        command = [sys.executable, "-P", "-m", "velod.runtime.hop", introducer_endpoint(settings), path]
        child = ChildProcess(command, on_line)
        stack.callback(stop_all, [child])
        plain = stack.enter_context(listener.accept()[0])
        outlet = stack.enter_context(Outlet(session, "hop"))
        raw = session.declare_publisher(_RAW_KEY, congestion_control=zenoh.CongestionControl.DROP)
        if not outlet.wait_for_subscriber(EVENTS, 10.0, camera=packet.camera):
            raise TimeoutError("the other end of the hop does not listen")
        _send(packet, 1 + -(-n // _RUN), outlet, raw, plain)
        plain.shutdown(socket.SHUT_WR)
        if not child.wait(10.0):
            raise TimeoutError("the other end of the hop does not end")
        child.why()  # reads its last line
    return {way: float(np.median(took[0][way][_RUN:])) * 1e-3 for way in WAYS}


def _send(packet: EventPacket, runs: int, outlet: Outlet, raw: Any, plain: socket.socket) -> None:
    body = bytearray(encode(packet, 0))

    def by_velod() -> None:
        outlet.publish(EVENTS, packet, camera=packet.camera)

    def by_zenoh() -> None:
        _TIME.pack_into(body, 0, time.time_ns())
        raw.put(body)

    def by_socket() -> None:
        _TIME.pack_into(body, 0, time.time_ns())
        plain.sendall(_LENGTH.pack(len(body)))
        plain.sendall(body)

    for _ in range(runs):
        for send in (by_velod, by_zenoh, by_socket):
            for _ in range(_RUN):
                time.sleep(_PAUSE_S)
                send()


class _Stage:
    """Takes whatever comes."""

    counters: ClassVar[dict[str, int]] = {}

    def handle(self, message: Any, /) -> Sequence[Message]:
        return []


class _Shell(WorkerShell):
    """A worker that notes how long each message took to reach its stage, which takes it as ingest does."""

    inputs: ClassVar[dict[Topic, int]] = {EVENTS: -1}
    in_place: ClassVar[bool] = True

    def __init__(self, session: zenoh.Session, settings: Settings) -> None:
        super().__init__(session, settings, "hop", "hop-0", _Stage())
        self.took_ns: list[int] = []

    def publish(self, outputs: Sequence[Message], cause: Envelope) -> None:
        self.took_ns.append(time.time_ns() - cause.t_pub_ns)


def _receive(plain: socket.socket, took_ns: list[int], stop: Event) -> None:
    """Messages from the socket, until its end."""
    with plain, plain.makefile("rb", buffering=0) as stream:
        while header := stream.read(_LENGTH.size):
            body = memoryview(bytearray(_LENGTH.unpack(header)[0]))
            at = 0
            while at < len(body):
                at += plain.recv_into(body[at:])
            took_ns.append(time.time_ns() - _TIME.unpack_from(body)[0])
    stop.set()


def main(argv: Sequence[str] | None = None) -> int:
    """The receiving end: writes what it noted on stderr when the socket is closed."""
    endpoint, path = sys.argv[1:] if argv is None else argv
    logging.basicConfig(level=logging.ERROR)
    settings = Settings(zenoh=ZenohSettings(connect=endpoint))
    prepare_process(0)
    stop = Event()
    raw_ns: list[int] = []
    plain_ns: list[int] = []

    def arrived(sample: zenoh.Sample) -> None:
        data = sample.payload.to_bytes()
        raw_ns.append(time.time_ns() - _TIME.unpack_from(data)[0])

    with ExitStack() as stack:
        session = stack.enter_context(open_session(settings.zenoh))
        stack.enter_context(session.declare_subscriber(_RAW_KEY, direct(arrived)))
        plain = socket.socket(socket.AF_UNIX)
        plain.connect(path)
        Thread(target=_receive, args=(plain, plain_ns, stop), daemon=True).start()
        shell = _Shell(session, Settings(rig=type(settings.rig)(name="hop")))
        shell.run(stop)
    took = dict(zip(WAYS, (shell.took_ns, raw_ns, plain_ns), strict=True))
    sys.stderr.write(f"{_TOOK}{json.dumps(took)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
