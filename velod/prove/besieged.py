"""A whole velod that others can reach, with certificates, a sensor far away and a consumer who watches the stream."""

from __future__ import annotations

import itertools
import math
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Any

import zenoh

from velod import config
from velod.client import Listener, VelocityClient
from velod.config import RigSettings, Settings, ZenohSettings
from velod.geometry.calibration_files import save_calibration
from velod.io import open_recording
from velod.runtime.certificates import make_keys
from velod.runtime.key_paths import KeyPaths
from velod.runtime.session import client_tree, open_session, to_config
from velod.runtime.stacked import Stacked
from velod.types import Health, Velocity
from velod.wire.topics import HEALTH

RIG = "rig0"
OTHER_RIG = "rig1"
START_S = 120.0
STAGES = ("ingest-0", "flow-0", "depth-0", "optimizer-0")


@dataclass(frozen=True, slots=True)
class Gap:
    """A time without a valid velocity at the consumer, and what was heard in it."""

    seconds: float
    begun_s: float  # time.monotonic()
    said: dict[str, str]  # by state of the velocities that were not valid: how many, and the last one's reason
    alarms: dict[str, str]  # by "worker name": the last text

    def __str__(self) -> str:
        """What was heard, in words."""
        heard = [f"{state}: {reason}" for state, reason in self.said.items()] or ["no velocity of any kind"]
        return "; ".join(heard + [f"{name} ({text})" for name, text in sorted(self.alarms.items())])


class SiegeError(RuntimeError):
    """The service did not come up, or the sensor could not reach it; one line."""


class Besieged(Stacked):
    """A context manager: `velod run` listening with TLS on loopback, a driver process that plays a recording to it
    over TLS at ``speed``, and a consumer over TLS. All processes are those that a user starts.
    """

    def __init__(self, recording: Path, speed: float) -> None:
        self._recording, self._speed = recording, speed
        self._health: dict[str, Health] = {}
        self._heard_s: list[float] = []  # when the consumer was handed a valid velocity
        self._unfit: list[tuple[float, str, str]] = []  # when it was handed another: state and reason
        self._alarms: list[tuple[float, str, str]] = []  # when, "worker name", text
        self._stop = Event()
        self.port, self.tls_port = free_port(), free_port()
        self.keys = Path()
        self.driver_pid = 0

    def _open(self, stack: ExitStack) -> None:
        """Raises SiegeError."""
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="velod-siege-")))
        self.keys = folder / "keys"
        make_keys(self.keys, rigs=(RIG, OTHER_RIG))
        self._start(stack, ["velod.cli", "run", "-c", str(self._settings(folder))])
        here = ZenohSettings(connect=f"tcp/127.0.0.1:{self.port}")
        self._watch(stack, Listener(RIG, (HEALTH,), here), self._note_health)
        self.wait_until(lambda: set(STAGES) <= set(self._health), START_S, "the service is not up")
        self.insider = stack.enter_context(open_session(here))
        # At another speed than 1 the sensor's time says nothing of age.
        consumer = VelocityClient(RIG, self.endpoint, math.inf, valid_only=False, keys=str(self.keys))
        self._watch(stack, consumer, self._note_velocity)
        player = ["velod.runtime.player", str(self._recording), *self._player_arguments()]
        self.driver_pid = self._start(stack, player)
        self.wait_until(lambda: len(self._heard_s) > 10, START_S, "no velocity came")

    @property
    def endpoint(self) -> str:
        """Where others reach it."""
        return f"tls/localhost:{self.tls_port}"

    def outsider(self, folder: Path, role: str, *, wait_ms: int = 3000, shows: bool = True) -> zenoh.Session:
        """A raw Zenoh session with the certificate of ``role`` in ``folder``; without it unless ``shows``.

        Raises zenoh.ZError where the service refuses it.
        """
        tree: dict[str, Any] = client_tree(self.endpoint, KeyPaths(folder), role)
        tree["connect"]["timeout_ms"] = wait_ms
        if not shows:
            tls = tree["transport"]["link"]["tls"]
            tree["transport"]["link"]["tls"] = {"root_ca_certificate": tls["root_ca_certificate"]}
        return zenoh.open(to_config(tree))

    def health_of(self, worker: str) -> Health:
        """What a worker said of itself last."""
        return self._health[worker]

    def gauge_of(self, pid: int, name: str) -> float:
        """What a process has said of itself last; 0 where it says nothing of that."""
        return next((h.gauges.get(name, 0.0) for h in self._health.values() if h.pid == pid), 0.0)

    def counted(self, worker: str, prefix: str) -> int:
        """The sum of a worker's counters that begin with ``prefix``."""
        return sum(n for name, n in self._health[worker].counters.items() if name.startswith(prefix))

    def process_ids(self) -> dict[str, int]:
        """Of the service and its workers."""
        return {worker: h.pid for worker, h in self._health.items() if h.stage != "driver"}

    def longest_gap(self) -> Gap:
        """Between two valid velocities at the consumer, until now."""
        heard = [*self._heard_s, time.monotonic()]
        seconds, begun_s = max(((b - a, a) for a, b in itertools.pairwise(heard)), default=(math.inf, heard[0]))
        said: dict[str, list[str]] = {}
        for t_s, state, reason in self._unfit:
            if begun_s < t_s < begun_s + seconds:
                said.setdefault(state, []).append(reason)
        alarms = {name: text for t_s, name, text in self._alarms if begun_s < t_s < begun_s + seconds}
        return Gap(seconds, begun_s, {state: f"{len(r)} times, {r[-1]}" for state, r in said.items()}, alarms)

    def n_heard(self) -> int:
        """Valid velocities at the consumer."""
        return len(self._heard_s)

    def wait_until(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        """Raises SiegeError with the text ``otherwise``."""
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline_s:
                raise SiegeError(f"{otherwise} after {timeout_s:g} s")
            time.sleep(0.05)

    def _settings(self, folder: Path) -> Path:
        calibration, path = folder / "rig.yaml", folder / "velod.toml"
        save_calibration(calibration, open_recording(self._recording).calibration)
        settings = Settings(
            rig=RigSettings(RIG, str(calibration)),
            zenoh=ZenohSettings(self.port, listen=f"tls/127.0.0.1:{self.tls_port}", keys=str(self.keys)),
        )
        path.write_text(config.to_toml(settings), "utf-8")
        return path

    def _player_arguments(self) -> list[str]:
        way = ["--connect", self.endpoint, "--keys", str(self.keys), "--role", "driver", "--rig", RIG]
        return [*way, "--speed", f"{self._speed:g}", "--repeat", "inf"]

    def _start(self, stack: ExitStack, module: list[str]) -> int:
        process = subprocess.Popen([sys.executable, "-P", "-m", *module], stderr=subprocess.DEVNULL)

        def end() -> None:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

        stack.callback(end)
        return process.pid

    def _watch(self, stack: ExitStack, source: Listener | VelocityClient, note: Callable[[Any], None]) -> None:
        stack.enter_context(source)

        def read() -> None:
            while not self._stop.is_set():
                if (received := source.receive(0.1)) is not None:
                    note(received)

        thread = Thread(target=read, daemon=True)
        thread.start()
        stack.callback(thread.join)
        stack.callback(self._stop.set)

    def _note_health(self, received: Any) -> None:
        health = received.envelope.message
        self._health[health.worker] = health
        now_s = time.monotonic()
        self._alarms += [(now_s, f"{health.worker} {name}", text) for name, text in health.alarms.items()]

    def _note_velocity(self, velocity: Velocity) -> None:
        if velocity.valid:
            self._heard_s.append(time.monotonic())
        else:
            self._unfit.append((time.monotonic(), velocity.state, velocity.reason))


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
