"""A consumer on a host of its own: ``consumer.py ENDPOINT OUT``, until SIGTERM.

A line of JSON for each velocity as it came in (``raw``) and as the client handed it out (``used``), with the host
time of that moment; one for each word of health; in the end the client's counters.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from dataclasses import asdict
from pathlib import Path
from threading import Event, Lock, Thread
from typing import IO, Any

from velod.client import Listener, VelocityClient
from velod.config import ZenohSettings
from velod.types import Health, Velocity
from velod.wire.topics import HEALTH, VELOCITY


def main() -> None:
    endpoint, out = sys.argv[1:]
    stop = Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    with Path(out).open("w", buffering=1) as file:
        log = _Log(file)
        with Listener("rig0", (VELOCITY, HEALTH), ZenohSettings(connect=endpoint, insecure=True)) as listener:
            print("ready", flush=True)
            raw = Thread(target=_note_raw, args=(listener, log, stop))
            raw.start()
            with VelocityClient("rig0", endpoint, valid_only=False, insecure=True) as client:
                while not stop.is_set():
                    velocity = client.receive(0.1)
                    if velocity is not None:
                        log.write("used", velocity, t_ns=time.time_ns())
                log.line({"kind": "end", "counters": client.counters})
            raw.join()


def _note_raw(listener: Listener, log: _Log, stop: Event) -> None:
    while not stop.is_set():
        received = listener.receive(0.1)
        if received is None:
            continue
        e = received.envelope
        if isinstance(e.message, Health):
            log.line({"kind": "health", **asdict(e.message), "received_t_ns": received.t_received_ns})
        elif isinstance(e.message, Velocity):
            log.write("raw", e.message, t_ns=received.t_received_ns, t_pub_ns=e.t_pub_ns, t_origin_ns=e.t_origin_ns)


class _Log:
    def __init__(self, file: IO[str]) -> None:
        self._file, self._lock = file, Lock()

    def write(self, kind: str, velocity: Velocity, **times: int) -> None:
        v = velocity
        said = {"seq": v.seq, "sensor_t_ns": v.t_ns, "v_B": v.v_B.tolist(), "valid": v.valid, "state": v.state}
        self.line({"kind": kind, **said, "batch": [v.batch_seq, v.batch_t_ns], **times})

    def line(self, row: dict[str, Any]) -> None:
        with self._lock:
            self._file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
