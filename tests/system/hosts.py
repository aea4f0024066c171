"""Hosts for tests: network namespaces on one switch, with links that can be cut, silenced and made poor.

Each host has its own network stack, host name and shared memory, so that nothing passes between two of them but
through the switch. Everything is made under names of this run and is gone afterwards, processes included.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import IO, Any

from velod.runtime.stacked import Stacked

SHAPER = Path(__file__).with_name("shaper.py")
_SHARED_MEMORY = Path("/dev/shm")
_runs = count()

# As a host of its own: its name, and shared memory that processes of this host alone see.
_BECOME_HOST = 'hostname "$1" && mount --bind "$2" /dev/shm && shift 2 && exec "$@"'


def why_not() -> str:
    """Why there can be no hosts here; empty where there can."""
    if sys.platform != "linux":
        return "network namespaces need Linux"
    if missing := [tool for tool in ("ip", "unshare", "mount", "hostname") if shutil.which(tool) is None]:
        return f"network namespaces need {', '.join(missing)} (iproute2, util-linux)"
    probe = f"velod-probe-{os.getpid()}"
    if subprocess.run(["ip", "netns", "add", probe], capture_output=True).returncode:
        return "network namespaces need root (CAP_SYS_ADMIN)"
    _ip("netns", "del", probe)
    return ""


@dataclass(slots=True)
class Host:
    """One network stack with an address; ``port`` is its end of the cable at the switch."""

    name: str
    namespace: str
    address: str
    port: str
    shared_memory: Path
    _network: Network
    processes: list[subprocess.Popen[str]] = field(default_factory=list)

    def start(self, command: Sequence[str], **options: Any) -> subprocess.Popen[str]:
        """Start a process on this host; it is ended with the network. Its id is that of the command itself."""
        own = ["unshare", "--uts", "sh", "-c", _BECOME_HOST, "sh", self.name, str(self.shared_memory)]
        process = subprocess.Popen(
            ["ip", "netns", "exec", self.namespace, *own, *command], text=True, process_group=0, **options
        )
        self.processes.append(process)
        return process

    def plug(self, *, connected: bool) -> None:
        """Put the cable in, or pull it out: both ends see that."""
        _ip("-n", self._network.switch, "link", "set", self.port, "up" if connected else "down")

    def black_hole(self, *, swallows: bool) -> None:
        """Let the switch swallow everything from and to this host; neither end is told."""
        master = ["nomaster"] if swallows else ["master", "br0"]
        _ip("-n", self._network.switch, "link", "set", self.port, *master)

    def shape(self, delay_ms: float, loss: float, mbit: float) -> None:
        """Make this host's link poor, each way: delay, share of frames lost, rate. Before any traffic, once."""
        self._network.insert_shaper(self, delay_ms, loss, mbit)


class Network(Stacked):
    """Hosts ``name -> Host`` on one switch. A context manager; nothing is made outside it."""

    def __init__(self, *names: str) -> None:
        prefix = f"velod-{os.getpid()}-{next(_runs)}"
        self.switch = f"{prefix}-switch"
        self.hosts = {
            name: Host(
                name, f"{prefix}-{name}", f"10.99.0.{i}", f"to-{name}", _SHARED_MEMORY / f"{prefix}-{name}", self
            )
            for i, name in enumerate(names, 1)
        }

    def __getitem__(self, name: str) -> Host:
        return self.hosts[name]

    def _open(self, stack: ExitStack) -> None:
        self._add_namespace(stack, self.switch)
        _ip("-n", self.switch, "link", "add", "br0", "type", "bridge")
        _ip("-n", self.switch, "link", "set", "br0", "up")
        for host in self.hosts.values():
            self._add_host(stack, host)
        self._introduce()

    def _add_namespace(self, stack: ExitStack, namespace: str) -> None:
        _ip("netns", "add", namespace)
        stack.callback(_ip, "netns", "del", namespace)
        _ip("-n", namespace, "link", "set", "lo", "up")

    def _add_host(self, stack: ExitStack, host: Host) -> None:
        self._add_namespace(stack, host.namespace)
        host.shared_memory.mkdir()
        stack.callback(shutil.rmtree, host.shared_memory, ignore_errors=True)
        stack.callback(_end_processes, host)
        cable = ("name", host.port, "type", "veth", "peer", "name", "eth0", "netns", host.namespace)
        _ip("-n", self.switch, "link", "add", *cable)
        _ip("-n", self.switch, "link", "set", host.port, "master", "br0", "up")
        _ip("-n", host.namespace, "addr", "add", f"{host.address}/24", "dev", "eth0")
        _ip("-n", host.namespace, "link", "set", "eth0", "up")

    def _introduce(self) -> None:
        """Every host knows the others' hardware addresses, as if they were behind routers.

        A black hole is then one for IP alone; otherwise hosts would look for each other by ARP, once a second.
        """
        for host in self.hosts.values():
            shown = subprocess.run(
                ["ip", "-n", host.namespace, "-json", "link", "show", "eth0"], check=True, capture_output=True
            )
            hardware = json.loads(shown.stdout)[0]["address"]
            for other in self.hosts.values():
                if other is not host:
                    at = ("neigh", "replace", host.address, "lladdr", hardware, "dev", "eth0", "nud", "permanent")
                    _ip("-n", other.namespace, *at)

    def insert_shaper(self, host: Host, delay_ms: float, loss: float, mbit: float) -> None:
        """A bridge of the host's own, and a process that carries frames from there to the switch and back."""
        own, near, far = f"br-{host.name}", f"near-{host.name}", f"far-{host.name}"
        command = [sys.executable, str(SHAPER), near, far, str(delay_ms), str(loss), str(mbit)]
        shaper = subprocess.Popen(
            ["ip", "netns", "exec", self.switch, *command], stdout=subprocess.PIPE, text=True, process_group=0
        )
        host.processes.append(shaper)
        assert shaper.stdout is not None
        assert shaper.stdout.readline() == "ready\n", "the shaper did not start"
        _ip("-n", self.switch, "link", "add", own, "type", "bridge")
        for port, bridge in ((host.port, own), (near, own), (far, "br0")):
            _ip("-n", self.switch, "link", "set", port, "master", bridge, "up")
        _ip("-n", self.switch, "link", "set", own, "up")


def _end_processes(host: Host) -> None:
    """What still runs on the host is killed, and what was started there is waited for."""
    listed = subprocess.run(["ip", "netns", "pids", host.namespace], capture_output=True, text=True).stdout
    running = [p.pid for p in host.processes if p.poll() is None]
    for pid in {*map(int, listed.split()), *running}:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue  # it has ended meanwhile
    for process in host.processes:
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            _close(pipe)


def _close(pipe: IO[str] | None) -> None:
    if pipe is not None:
        pipe.close()


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)
