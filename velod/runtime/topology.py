"""Zenoh configurations for the networks that velod is used in, as files for ``zenoh.config`` and ``velod router``.

They are what velod builds from its settings, written out: for processes in other languages, and for networks that
settings alone cannot say.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from velod.runtime.access import Role, access_control
from velod.runtime.key_paths import KeyPaths
from velod.runtime.session import client_tree, peer_tree, router_tree
from velod.wire.topics import VELOCITY, key

PORT: Final = 17447
"""On loopback."""
TLS_PORT: Final = 17448


@dataclass(frozen=True, slots=True)
class Site:
    """What differs from one installation to the next."""

    host: str = "velod.local"  # name or address of the router, as others reach it
    keys: str = "/etc/velod/keys"  # where each host keeps its certificates
    rigs: tuple[str, ...] = ()  # with certificates of their own
    max_hz: float = 0.0  # velocities per second and rig over a poor link; 0: all


File = tuple[str, str, dict[str, Any]]  # name, what it is for, configuration


def local(site: Site) -> list[File]:
    """One machine, no router: what velod does by itself, for a driver or a consumer in another language."""
    del site
    tree = peer_tree(["tcp/127.0.0.1:0"], [f"tcp/127.0.0.1:{PORT}"])
    return [("local.json5", "Any process of this host: a peer that finds the others through 127.0.0.1.", tree)]


def robot(site: Site) -> list[File]:
    """A robot and a compute host: workers there are clients of the robot's router."""
    tree = router_tree(_listens(), [], KeyPaths(Path(site.keys)), site.rigs, "")
    compute = client_tree(_server(site), KeyPaths(Path(site.keys)), "worker")
    return [
        ("robot-router.json5", "`velod router` on the robot; its other processes take local.json5.", tree),
        ("compute.json5", "Workers on the compute host: clients of the robot's router, as worker.", compute),
        *local(site),
    ]


def fleet(site: Site) -> list[File]:
    """Several rigs, one router: each rig's own router links to it, consumers are clients."""
    hub = router_tree(_listens(), [], KeyPaths(Path(site.keys)), site.rigs, "")
    rig = router_tree([f"tcp/127.0.0.1:{PORT}"], [_server(site)], KeyPaths(Path(site.keys)), site.rigs, "worker")
    return [
        ("fleet-router.json5", "`velod router` where the rigs meet.", hub),
        ("rig-router.json5", "`velod router` on each rig; its other processes take local.json5.", rig),
        _consumer(site),
        *local(site),
    ]


def remote(site: Site) -> list[File]:
    """A remote consumer over a poor link: nothing but velocity crosses it, no more often than is asked for."""
    tree = router_tree(_listens(), [], KeyPaths(Path(site.keys)), site.rigs, "")
    only_velocity = {"consumer": Role(subscribes=(key(VELOCITY, "{rig}"),))}
    tree["access_control"] = access_control(site.rigs, only_velocity)
    if site.max_hz:
        # One rule for each rig: rigs under the same rule would share its rate.
        tree["downsampling"] = [
            {
                "id": "poor-link",
                "link_protocols": ["tls", "quic"],
                "flows": ["egress"],
                "messages": ["put"],
                "rules": [{"key_expr": key(VELOCITY, rig), "freq": site.max_hz} for rig in site.rigs or ("rig0",)],
            }
        ]
    return [
        ("remote-router.json5", "`velod router` beside velod; its other processes take local.json5.", tree),
        _consumer(site),
        *local(site),
    ]


TOPOLOGIES: Final[dict[str, Callable[[Site], list[File]]]] = {
    "local": local,
    "robot": robot,
    "fleet": fleet,
    "remote": remote,
}


def write(name: str, site: Site, folder: str | Path) -> list[Path]:
    """Write the files of a topology; returns their paths."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for file, purpose, tree in TOPOLOGIES[name](site):
        path = folder / file
        path.write_text(
            f"// {purpose}\n// Written by `velod config topology`.\n{json.dumps(tree, indent=2)}\n", "utf-8"
        )
        written.append(path)
    return written


def _listens() -> list[str]:
    return [f"tcp/127.0.0.1:{PORT}", f"tls/0.0.0.0:{TLS_PORT}"]


def _server(site: Site) -> str:
    return f"tls/{site.host}:{TLS_PORT}"


def _consumer(site: Site) -> File:
    tree = client_tree(_server(site), KeyPaths(Path(site.keys)), "consumer")
    return ("consumer.json5", "A consumer anywhere: a client of the router, as consumer.", tree)
