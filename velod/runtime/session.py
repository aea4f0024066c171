"""Zenoh sessions: peers on loopback that find each other through one introducer on a fixed port, without a router.

Each process listens on a port of its own; the introducer tells them of each other by gossip, and may die without
cutting a link. Leases, queues and retries are set so that a link that was cut is given up within 2 s and is back
without serving stale samples (measured; Zenoh's defaults take longer and serve what is old).

From other hosts, with TLS, processes are clients of the introducer, which asks for their certificates and lets each
role do what ``access`` says.
"""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import zenoh

from velod.config import ZenohSettings
from velod.runtime.access import SERVER, access_control, size_limits
from velod.runtime.endpoints import ANY_HOST, Endpoint, SessionError, parse, refuse_missing_keys, refuse_what_is_open
from velod.runtime.key_paths import KeyPaths
from velod.runtime.links import keep_from_blocking
from velod.runtime.pools import POOL_BYTES
from velod.runtime.relink import keep_linked, tell_of_links
from velod.wire.schema import MAX_BYTES

__all__ = ["SessionError", "introducer_endpoint", "open_session"]

CLIENT_WAIT_MS = 5000
"""So long may a client's first connection take."""
SHARED_FROM_BYTES = 65_536
"""Messages so large go through shared memory: events and batches, and no worker's results. Zenoh locks the pool of
every process that sends one into the memory of all who receive it (``pools`` gives it back when that one is gone)."""


def open_session(settings: ZenohSettings, introducer: bool = False, rigs: Sequence[str] = ()) -> zenoh.Session:
    """Open a session; close it with ``with``: one left open hangs the process at its exit.

    The introducer listens on the fixed port and serves as the first contact of all others; ``rigs`` are those whose
    own certificates it knows. Raises SessionError, and CertificateError where certificates are missing or wrong.
    """
    config = load_config(settings.config) if settings.config else _build(settings, introducer, rigs)
    if not settings.insecure:
        refuse_what_is_open(config, settings.config or "zenoh")
    return open_config(config, settings, introducer)


def open_config(config: zenoh.Config, settings: ZenohSettings, introducer: bool = False) -> zenoh.Session:
    """Open a session with a configuration that was made from ``settings``. Raises SessionError."""
    refuse_missing_keys(settings.keys)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as e:
        raise SessionError(_explain(str(e), settings, introducer)) from None
    except BaseException as e:
        # A panic of Zenoh's is no Exception, and its class cannot be imported.
        if type(e).__name__ != "PanicException":
            raise
        raise SessionError(_explain(str(e), settings, introducer)) from None
    keep_from_blocking(session)
    if introducer:
        tell_of_links(session)
    else:
        keep_linked(session)
    return session


def introducer_endpoint(settings: ZenohSettings) -> str:
    """Where the processes of this service find the introducer."""
    return settings.connect or f"tcp/127.0.0.1:{settings.port}"


def load_config(file: str) -> zenoh.Config:
    """A configuration from a JSON5 file. Raises SessionError."""
    path = Path(file)
    if not path.is_file():
        raise SessionError(f"{path}: no such file (zenoh.config)")
    try:
        return zenoh.Config.from_file(path)
    except zenoh.ZError as e:
        raise SessionError(f"{path}: not a zenoh configuration: {_first_line(str(e))}") from None


def _build(settings: ZenohSettings, introducer: bool, rigs: Sequence[str]) -> zenoh.Config:
    connect, listen = (
        parse(endpoint, f"zenoh.{name}") if endpoint else None
        for name, endpoint in (("connect", settings.connect), ("listen", settings.listen))
    )
    is_introducer = introducer and not settings.connect
    if connect is not None and connect.is_guarded:
        tree = client_tree(settings.connect, key_files(settings, settings.role), settings.role)
    else:
        listens = _introducer_listens(settings) if is_introducer else _peer_listens(settings)
        tree = peer_tree(
            listens,
            [] if is_introducer else [introducer_endpoint(settings)],
            settings.shared_memory,
            settings.lossless,
        )
        if is_introducer and listen is not None and listen.is_guarded:
            guard(tree, key_files(settings, SERVER), rigs)
    return to_config(tree)


def to_config(tree: dict[str, Any]) -> zenoh.Config:
    """A tree of settings as Zenoh takes it."""
    return zenoh.Config.from_json5(json.dumps(tree))


def key_files(settings: ZenohSettings, name: str) -> KeyPaths:
    """The certificate of a role, or of the server, once it was looked at. Raises CertificateError, SessionError."""
    if not settings.keys:
        raise SessionError("tls/ endpoints need certificates: set zenoh.keys (`velod config keys` makes them)")
    try:
        from velod.runtime.certificates import check_keys
    except ImportError:
        raise SessionError("tls/ endpoints need the package cryptography: pip install 'velod[keys]'") from None
    return check_keys(settings.keys, name)


def peer_tree(listens: list[str], connects: list[str], shared_memory: bool = True, lossless: bool = False) -> Any:
    """A process of this host: a peer that links to all others which it hears of."""
    return {
        "mode": "peer",
        "listen": {"endpoints": {"peer": listens}, "exit_on_failure": True},
        "connect": {
            "endpoints": {"peer": connects},
            # Opening does not wait, and whoever comes first is found later: tried for ever in the background.
            # (With a timeout of 0 a first attempt that fails is the last one.)
            "timeout_ms": {"peer": -1},
            "exit_on_failure": {"peer": False},
            "retry": _RETRY,
        },
        "scouting": {
            "multicast": {"enabled": False},
            "gossip": {
                "enabled": True,
                "autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
            },
        },
        "timestamping": _TIMESTAMPING,
        "transport": _transport(shared_memory, lossless),
    }


def client_tree(connect: str, files: KeyPaths | None = None, role: str = "") -> Any:
    """A process that knows one endpoint, of a router or of an introducer; with ``files`` it shows a certificate."""
    tree: dict[str, Any] = {
        "mode": "client",
        "connect": {
            "endpoints": [connect],
            "timeout_ms": CLIENT_WAIT_MS,
            "exit_on_failure": True,
            "retry": _RETRY,
        },
        "scouting": {"multicast": {"enabled": False}},
        "timestamping": _TIMESTAMPING,
        "transport": _transport(shared_memory=files is None, lossless=False),
    }
    if files is not None:
        _show_certificate(tree, files, role)
    return tree


def router_tree(
    listens: list[str], connects: list[str], files: KeyPaths | None, rigs: Sequence[str], role: str
) -> Any:
    """A router; with ``files`` it asks those who connect for certificates, and shows ``role``'s to other routers."""
    tree = peer_tree(listens, connects)
    tree["mode"] = "router"
    tree["listen"]["endpoints"] = listens
    tree["connect"] = {**tree["connect"], "endpoints": connects, "timeout_ms": -1, "exit_on_failure": False}
    # A hundred rigs are a hundred links and more.
    tree["transport"]["unicast"] = {"max_sessions": 4096, "accept_pending": 512}
    if files is not None:
        guard(tree, files, rigs)
        if connects:
            _show_certificate(tree, files, role)
    return tree


def guard(tree: dict[str, Any], files: KeyPaths, rigs: Sequence[str]) -> None:
    """Ask everyone who connects for a certificate, and let each role do what it may."""
    tree["transport"]["link"].setdefault("tls", {}).update(
        root_ca_certificate=str(files.ca),
        listen_certificate=str(files.certificate(SERVER)),
        listen_private_key=str(files.key(SERVER)),
        enable_mtls=True,
        close_link_on_expiration=True,
    )
    tree["access_control"] = access_control(rigs)
    tree["low_pass_filter"] = size_limits()


def _show_certificate(tree: dict[str, Any], files: KeyPaths, role: str) -> None:
    tree["transport"]["link"].setdefault("tls", {}).update(
        root_ca_certificate=str(files.ca),
        connect_certificate=str(files.certificate(role)),
        connect_private_key=str(files.key(role)),
        enable_mtls=True,  # without it a client sends no certificate
        verify_name_on_connect=True,
        close_link_on_expiration=True,
    )


_RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
_TIMESTAMPING = {"enabled": {"router": True, "peer": False, "client": False}}


def _transport(shared_memory: bool, lossless: bool) -> dict[str, Any]:
    return {
        "link": {
            "tx": {
                "lease": 2000,
                "keep_alive": 4,
                "queue": {
                    "size": {"data": 16, "data_low": 16},
                    "congestion_control": {
                        "drop": {"wait_before_drop": 1000, "max_wait_before_drop_fragments": 20000},
                        "block": {"wait_before_close": 60_000_000 if lossless else 1_000_000},
                    },
                },
            },
            "rx": {"buffer_size": 2097152, "max_message_size": MAX_BYTES},
        },
        "shared_memory": {
            "enabled": shared_memory,
            # "init" takes a piece of /dev/shm even where it is not enabled, and panics where there is none.
            "mode": "init" if shared_memory else "lazy",
            "transport_optimization": {
                "enabled": shared_memory,
                "pool_size": POOL_BYTES,
                "message_size_threshold": SHARED_FROM_BYTES,
                "messages": ["put"],
            },
        },
    }


def _introducer_listens(settings: ZenohSettings) -> list[str]:
    loopback = f"tcp/127.0.0.1:{settings.port}"
    if not settings.listen:
        return [loopback]
    listen = parse(settings.listen, "zenoh.listen")
    # A wildcard address holds loopback already; binding both would be "address in use".
    covered = listen.host in (*ANY_HOST, "127.0.0.1") and listen.port == settings.port
    if covered and listen.is_guarded:
        raise SessionError(f"zenoh.listen: {settings.listen}: port {listen.port} is zenoh.port; choose another one")
    return [settings.listen] if covered else [loopback, settings.listen]


def _peer_listens(settings: ZenohSettings) -> list[str]:
    """Loopback, and where other hosts are involved the address that they reach, each with a port of its own."""
    listens = ["tcp/127.0.0.1:0"]
    if settings.listen:
        listen = parse(settings.listen, "zenoh.listen")
        if not listen.is_guarded:  # there the introducer alone is reached from outside, and passes on
            listens.append(listen.on_any_port())
    elif settings.connect:
        connect = parse(settings.connect, "zenoh.connect")
        address = _address_towards(connect.host.strip("[]"), connect.port)
        if address is not None and not address.startswith("127."):
            listens.append(f"tcp/{f'[{address}]' if ':' in address else address}:0")
    return ["tcp/0.0.0.0:0"] if "tcp/0.0.0.0:0" in listens else list(dict.fromkeys(listens))


def _address_towards(host: str, port: int) -> str | None:
    """This host's own address on the way to ``host``; None if it cannot be reached. Sends nothing."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind) as probe:
            probe.connect(address)
            return str(probe.getsockname()[0])
    except OSError:
        return None


def _explain(error: str, settings: ZenohSettings, introducer: bool) -> str:
    listener = re.search(r"bound to (\S+?:(\d+))", error)
    if "in use" in error and listener is not None:
        return (
            f"port {listener[2]} is already in use: another velod may be running here;"
            f" stop it, or choose another zenoh.port (wanted {listener[1].rstrip(':')})"
        )
    if "shm segment" in error:
        return (
            "no shared memory: /dev/shm is full, read-only or missing; make room there (docker: --shm-size),"
            " or set zenoh.shared_memory = false"
        )
    endpoint = f"tcp/127.0.0.1:{settings.port}" if introducer else introducer_endpoint(settings)
    cause = _first_line(error)
    if not settings.config and settings.keys and endpoint.startswith(("tls/", "quic/")):
        cause = _verdict(parse(endpoint, "zenoh.connect"), settings) or cause
    return f"no zenoh session ({settings.config or endpoint}): {cause}"


def _verdict(endpoint: Endpoint, settings: ZenohSettings) -> str:
    """What a TLS server says where Zenoh says nothing."""
    from velod.runtime.verdict import tls_verdict

    return tls_verdict(endpoint, key_files(settings, settings.role), settings.role)


def _first_line(error: str) -> str:
    """Zenoh's errors carry the places in its sources; a user needs the text before them."""
    return re.split(r"\s+at /|\n", error.strip(), maxsplit=1)[0].strip(" .[")
