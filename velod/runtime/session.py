"""Zenoh sessions: peers on loopback that find each other through one introducer on a fixed port, without a router.

Each process listens on a port of its own; the introducer tells them of each other by gossip, and may die without
cutting a link. Leases, queues and retries are set so that a link that was cut is given up within 2 s and is back
without serving stale samples (measured; Zenoh's defaults take longer and serve what is old).
"""

from __future__ import annotations

import json
import re
import socket
from pathlib import Path
from typing import Any

import zenoh

from velod.config import ZenohSettings

_ENDPOINT = re.compile(r"(tcp|tls|quic)/(?P<host>\[[0-9a-fA-F:.]+\]|[^\[\]:/#?]+):(?P<port>\d{1,5})(#.*)?")
_ANY_HOST = ("0.0.0.0", "[::]")


class SessionError(OSError):
    """A session that cannot be opened; one line that names the endpoint or the file, and the cause."""


def open_session(settings: ZenohSettings, introducer: bool = False) -> zenoh.Session:
    """Open a session; close it with ``with``: one left open hangs the process at its exit.

    The introducer listens on the fixed port and serves as the first contact of all others. Raises SessionError.
    """
    config = _load(Path(settings.config)) if settings.config else _build(settings, introducer)
    try:
        return zenoh.open(config)
    except zenoh.ZError as e:
        raise SessionError(_explain(str(e), settings, introducer)) from None


def introducer_endpoint(settings: ZenohSettings) -> str:
    """Where the processes of this service find the introducer."""
    return settings.connect or f"tcp/127.0.0.1:{settings.port}"


def _load(path: Path) -> zenoh.Config:
    if not path.is_file():
        raise SessionError(f"{path}: no such file (zenoh.config)")
    try:
        return zenoh.Config.from_file(path)
    except zenoh.ZError as e:
        raise SessionError(f"{path}: not a zenoh configuration: {_first_line(str(e))}") from None


def _build(settings: ZenohSettings, introducer: bool) -> zenoh.Config:
    for name, endpoint in (("connect", settings.connect), ("listen", settings.listen)):
        if endpoint:
            _parse(endpoint, f"zenoh.{name}")
    is_introducer = introducer and not settings.connect
    listen = _introducer_listens(settings) if is_introducer else _peer_listens(settings)
    return zenoh.Config.from_json5(json.dumps(_tree(settings, listen, connect=not is_introducer)))


def _tree(settings: ZenohSettings, listen: list[str], connect: bool) -> dict[str, Any]:
    return {
        "mode": "peer",
        "listen": {"endpoints": {"peer": listen}, "exit_on_failure": True},
        "connect": {
            "endpoints": {"peer": [introducer_endpoint(settings)] if connect else []},
            # Opening does not wait, and whoever comes first is found later: tried for ever in the background.
            # (With a timeout of 0 a first attempt that fails is the last one.)
            "timeout_ms": {"peer": -1},
            "exit_on_failure": {"peer": False},
            "retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
        },
        "scouting": {
            "multicast": {"enabled": False},
            "gossip": {
                "enabled": True,
                "autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
            },
        },
        "timestamping": {"enabled": {"router": True, "peer": False, "client": False}},
        "transport": {
            "link": {
                "tx": {
                    "lease": 2000,
                    "keep_alive": 4,
                    "queue": {
                        "size": {"data": 16, "data_low": 16},
                        "congestion_control": {
                            "drop": {"wait_before_drop": 1000, "max_wait_before_drop_fragments": 20000},
                            "block": {"wait_before_close": 60_000_000 if settings.lossless else 1_000_000},
                        },
                    },
                },
                "rx": {"buffer_size": 2097152},
            },
            "shared_memory": {
                "enabled": settings.shared_memory,
                "mode": "init",
                "transport_optimization": {
                    "enabled": settings.shared_memory,
                    "pool_size": 67108864,
                    "message_size_threshold": 16384,
                    "messages": ["put"],
                },
            },
        },
    }


def _introducer_listens(settings: ZenohSettings) -> list[str]:
    loopback = f"tcp/127.0.0.1:{settings.port}"
    if not settings.listen:
        return [loopback]
    host, port = _parse(settings.listen, "zenoh.listen")
    # A wildcard address holds loopback already; binding both would be "address in use".
    covered = host in (*_ANY_HOST, "127.0.0.1") and port == settings.port
    return [settings.listen] if covered else [loopback, settings.listen]


def _peer_listens(settings: ZenohSettings) -> list[str]:
    """Loopback, and where other hosts are involved the address that they reach, each with a port of its own."""
    listens = ["tcp/127.0.0.1:0"]
    if settings.listen:
        listens.append(_with_port_0(settings.listen))
    elif settings.connect:
        host, port = _parse(settings.connect, "zenoh.connect")
        address = _address_towards(host.strip("[]"), port)
        if address is not None and not address.startswith("127."):
            listens.append(f"tcp/{f'[{address}]' if ':' in address else address}:0")
    return ["tcp/0.0.0.0:0"] if "tcp/0.0.0.0:0" in listens else list(dict.fromkeys(listens))


def _with_port_0(endpoint: str) -> str:
    match = _ENDPOINT.fullmatch(endpoint)
    assert match is not None, "checked before"
    return f"{match[1]}/{match['host']}:0{match[4] or ''}"


def _address_towards(host: str, port: int) -> str | None:
    """This host's own address on the way to ``host``; None if it cannot be reached. Sends nothing."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind) as probe:
            probe.connect(address)
            return str(probe.getsockname()[0])
    except OSError:
        return None


def _parse(endpoint: str, where: str) -> tuple[str, int]:
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 1 <= int(match["port"]) <= 65535:
        raise SessionError(f"{where}: must be an endpoint such as tcp/192.168.1.5:17447, got {endpoint!r}")
    return match["host"], int(match["port"])


def _explain(error: str, settings: ZenohSettings, introducer: bool) -> str:
    listener = re.search(r"bound to (\S+?:(\d+))", error)
    if "in use" in error and listener is not None:
        return (
            f"port {listener[2]} is already in use: another velod may be running here;"
            f" stop it, or choose another zenoh.port (wanted {listener[1].rstrip(':')})"
        )
    endpoint = f"tcp/127.0.0.1:{settings.port}" if introducer else introducer_endpoint(settings)
    return f"no zenoh session ({settings.config or endpoint}): {_first_line(error)}"


def _first_line(error: str) -> str:
    """Zenoh's errors carry the places in its sources; a user needs the text before them."""
    return re.split(r"\s+at /|\n", error.strip(), maxsplit=1)[0].strip(" .[")
