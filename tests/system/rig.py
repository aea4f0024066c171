"""A whole rig on hosts: sensor, compute and consumer, and what the consumer saw."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread
from typing import Any, Self

import numpy as np

from tests.system.hosts import Host, Network
from velod import config
from velod.config import Settings
from velod.geometry.calibration_files import save_calibration
from velod.io import Recording, open_recording

CONSUMER = Path(__file__).with_name("consumer.py")
PORT = 17447
UP_S = 90.0
"""Workers of a busy machine take their time to load."""


@dataclass(slots=True)
class Seen:
    """What a consumer saw, in its order of arrival; times in s, from the first velocity's arrival on."""

    raw: list[dict[str, Any]]
    used: list[dict[str, Any]]
    health: list[dict[str, Any]]
    counters: dict[str, int]

    @staticmethod
    def read(path: Path) -> Seen:
        """From the file that ``consumer.py`` wrote."""
        rows = [json.loads(line) for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]
        kinds: dict[str, list[dict[str, Any]]] = {"raw": [], "used": [], "health": [], "end": []}
        for row in rows:
            kinds[row["kind"]].append(row)
        return Seen(kinds["raw"], kinds["used"], kinds["health"], kinds["end"][0]["counters"] if kinds["end"] else {})

    def valid(self) -> list[dict[str, Any]]:
        """What was handed out as valid."""
        return [row for row in self.used if row["valid"]]

    def newest_health(self) -> dict[str, dict[str, Any]]:
        """Of each process, by worker."""
        return {row["worker"]: row for row in self.health}

    def longest_gap_s(self) -> float:
        """Between two valid velocities handed out."""
        return float(np.diff([row["t_ns"] for row in self.valid()]).max() * 1e-9)

    def longest_step_s(self) -> float:
        """Of sensor time between two velocities handed out; negative: it went back."""
        steps = np.diff([row["sensor_t_ns"] for row in self.used]) * 1e-9
        return float(steps.min() if steps.min() <= 0.0 else steps.max())

    def oldest_ms(self) -> float:
        """The largest true age of a valid velocity when it was handed out, less the least latency of all."""
        offset_ns = min(row["t_pub_ns"] - row["sensor_t_ns"] for row in self.raw)
        return max(row["t_ns"] - row["sensor_t_ns"] - offset_ns for row in self.valid()) * 1e-6

    def lost(self) -> int:
        """Ticks of the output rate that were never handed out, between the first and the last."""
        t_ns = {row["sensor_t_ns"] for row in self.used}
        return round((max(t_ns) - min(t_ns)) * 75e-9) + 1 - len(t_ns)

    def lost_on_the_way(self) -> int:
        """Velocities that never arrived; those that came in one burst, of which a client keeps the newest, did."""
        return self.counters.get("gap.velocity", 0) - self.counters.get("inbox.overflow.velocity", 0)

    def latency_ms(self) -> np.ndarray:
        """Batch closed -> velocity at the consumer, for the first velocity that uses each batch, ms."""
        first: dict[tuple[int, int], float] = {}
        for row in self.raw:
            if row["t_origin_ns"]:
                first.setdefault(tuple(row["batch"]), (row["t_ns"] - row["t_origin_ns"]) * 1e-6)
        return np.array(list(first.values()))

    def travel_ms(self) -> np.ndarray:
        """Published -> arrived, ms; the hosts of a test share one clock."""
        return np.array([(row["t_ns"] - row["t_pub_ns"]) * 1e-6 for row in self.raw])


class Stalls:
    """How long this machine keeps a process from running, while the context lasts; next to nothing on a quiet one."""

    _SLEEP_S = 0.005

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._stop = Event()
        self._thread = Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._stop.is_set():
            before_s = time.monotonic()
            time.sleep(self._SLEEP_S)
            self.longest_s = max(self.longest_s, time.monotonic() - before_s - self._SLEEP_S)


@dataclass(slots=True)
class Rig:
    """``network`` has a host ``compute``, and whatever others a test asks for."""

    network: Network
    recording: Path
    directory: Path
    settings: Settings = field(default_factory=Settings)
    entrance: str = ""  # of a router that all processes meet at, instead of the introducer
    service: subprocess.Popen[str] | None = None
    router: subprocess.Popen[str] | None = None

    @property
    def compute(self) -> Host:
        """Where the service runs."""
        return self.network["compute"]

    @property
    def endpoint(self) -> str:
        """Where the service is reached, from any host."""
        return self.entrance or f"tcp/{self.compute.address}:{PORT}"

    def recorded(self) -> Recording:
        """The recording that is played."""
        return open_recording(self.recording)

    def start_service(self, only: str = "", *, spare: bool = True) -> None:
        """``velod run`` on the compute host, until all of its workers, and the spare, are up."""
        calibration, settings = self.directory / "rig.yaml", self.directory / "velod.toml"
        save_calibration(calibration, self.recorded().calibration)
        tree = config.to_tree(self.settings)
        tree["rig"]["calibration"] = str(calibration)
        tree["zenoh"].update(listen=self.endpoint, insecure=True)
        settings.write_text(config.to_toml(config.from_tree(tree)))
        options = ["--only", only] if only else []
        self.service = self._velod(self.compute, "service", "run", "-c", str(settings), *options)
        workers = {"flow": self.settings.flow.workers, "depth": self.settings.depth.workers}
        stages = only.split(",") if only else ["ingest", "flow", "depth", "optimizer"]
        expected = sum(workers.get(stage, 1) for stage in stages)
        self.wait_for("service", "INFO up", expected)
        if spare and not only:
            self.wait_for("service", "spare is ready", 1)

    def start_router(self, endpoint: str) -> None:
        """A router on the compute host, until it listens."""
        arguments = ["router", "--port", str(PORT + 1), "--listen", endpoint, "--insecure"]
        self.router = self._velod(self.compute, "router", *arguments)
        self.wait_for("router", "INFO up", 1)

    def kill_router(self) -> None:
        """kill -9."""
        assert self.router is not None
        self.router.kill()
        self.router.wait()

    def start_worker(self, host: str, worker: str) -> subprocess.Popen[str]:
        """One more worker, on any host, until it is up."""
        stage = worker.partition("-")[0]
        command = [sys.executable, "-P", "-m", f"velod.workers.{stage}", "--connect", self.endpoint, "--insecure"]
        process = self.start(self.network[host], worker, [*command, "--worker", worker])
        self.wait_for(worker, "INFO up", 1)
        return process

    def start_slow_worker(self, host: str, worker: str, ms: float) -> subprocess.Popen[str]:
        """A flow worker that takes so much longer for each batch, until it is up."""
        command = [sys.executable, "-P", "-m", "velod.prove.slow_worker", self.endpoint, worker, str(ms)]
        process = self.start(self.network[host], worker, command)
        self.wait_for(worker, "INFO up", 1)
        return process

    def start_player(self, host: str, speed: str = "1") -> subprocess.Popen[str]:
        """The sensor: plays the recording to its end."""
        command = [sys.executable, "-P", "-m", "velod.runtime.player", str(self.recording), "--speed", speed]
        return self.start(self.network[host], "player", [*command, "--connect", self.endpoint, "--insecure"])

    def start_consumer(self, host: str, name: str = "consumer") -> subprocess.Popen[str]:
        """Somebody who takes velocities, until it is told to end."""
        command = [sys.executable, str(CONSUMER), self.endpoint, str(self.directory / f"{name}.jsonl")]
        consumer = self.start(self.network[host], name, command, stdout=subprocess.PIPE)
        assert consumer.stdout is not None
        assert consumer.stdout.readline() == "ready\n"
        return consumer

    def seen(self, consumer: subprocess.Popen[str], name: str = "consumer") -> Seen:
        """End a consumer and read what it saw."""
        consumer.send_signal(signal.SIGTERM)
        consumer.wait(10.0)
        return self.seen_so_far(name)

    def seen_so_far(self, name: str = "consumer") -> Seen:
        """What a consumer has seen until now."""
        return Seen.read(self.directory / f"{name}.jsonl")

    def velod(self, host: str, *arguments: str) -> str:
        """Run a velod command on a host to its end; what it printed."""
        name = f"velod-{arguments[0]}"
        process = self._velod(self.network[host], name, *arguments, stdout=subprocess.PIPE)
        out, _ = process.communicate(timeout=60.0)
        return out

    def log(self, name: str) -> str:
        """What a process has written on stderr."""
        return (self.directory / f"{name}.log").read_text()

    def wait_for(self, name: str, text: str, times: int, timeout_s: float = UP_S) -> None:
        """Until a process has logged this so often."""
        deadline_s = time.monotonic() + timeout_s
        while self.log(name).count(text) < times:
            assert time.monotonic() < deadline_s, f"{name} has not said {text!r}:\n{self.log(name)}"
            time.sleep(0.05)

    def start(self, host: Host, name: str, command: list[str], **options: Any) -> subprocess.Popen[str]:
        """Start any process; its log goes to ``name``.log."""
        with (self.directory / f"{name}.log").open("w") as log:
            return host.start(command, stderr=log, **options)

    def wait_for_velocities(self, n: int, name: str = "consumer", timeout_s: float = 30.0) -> None:
        """Until a consumer has been handed so many."""
        path, deadline_s = self.directory / f"{name}.jsonl", time.monotonic() + timeout_s
        while path.read_text().count('"used"') < n:
            assert time.monotonic() < deadline_s, f"{name} has not seen {n} velocities"
            time.sleep(0.02)

    def _velod(self, host: Host, name: str, *arguments: str, **options: Any) -> subprocess.Popen[str]:
        return self.start(host, name, [sys.executable, "-P", "-m", "velod.cli", *arguments], **options)


def pid_of(worker: str, host: Host) -> int:
    """The process that was started as this worker on this host."""
    listed = subprocess.run(["ip", "netns", "pids", host.namespace], capture_output=True, text=True, check=True)
    for pid in listed.stdout.split():
        arguments = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
        if worker in arguments:
            return int(pid)
    raise AssertionError(f"no {worker} on {host.name}")
