"""Endpoints, and what may go beyond this host: nothing, unless certificates guard it or the settings say so."""

from __future__ import annotations

import ipaddress
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

_ENDPOINT = re.compile(
    r"(?P<protocol>tcp|tls|quic)/(?P<host>\[[0-9a-fA-F:.]+\]|[^\[\]:/#?]+):(?P<port>\d{1,5})(#.*)?"
)
_GUARDED = ("tls", "quic")
_WITHIN_HOST = ("unixsock-stream", "unixpipe")
ANY_HOST = ("0.0.0.0", "[::]")


class SessionError(OSError):
    """A session that cannot be opened; one line that names the endpoint or the file, and the cause."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """``tcp/192.168.1.5:17447``, taken apart. An IPv6 host keeps its brackets."""

    protocol: str
    host: str
    port: int
    options: str = ""  # "#iface=eth0"

    @property
    def is_guarded(self) -> bool:
        """Whether the other side has to show a certificate."""
        return self.protocol in _GUARDED

    @property
    def is_loopback(self) -> bool:
        """Whether it stays within this host."""
        return is_loopback(self.host)

    def on_any_port(self) -> str:
        """The same endpoint on a port that the system chooses."""
        return f"{self.protocol}/{self.host}:0{self.options}"


def parse(endpoint: str, where: str) -> Endpoint:
    """An endpoint; ``where`` names the setting in errors. Raises SessionError."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 1 <= int(match["port"]) <= 65535:
        raise SessionError(f"{where}: must be an endpoint such as tcp/192.168.1.5:17447, got {endpoint!r}")
    return Endpoint(match["protocol"], match["host"], int(match["port"]), match[4] or "")


def refuse_missing_keys(folder: str) -> None:
    """Raise SessionError where ``folder``, of certificates, is named and not there.

    Also where no endpoint asks for one: who names it believes that it guards something.
    """
    if folder and not Path(folder).is_dir():
        raise SessionError(f"{folder}: no such folder (zenoh.keys); `velod config keys` makes certificates")


def is_loopback(host: str) -> bool:
    """Whether a host's name or address is this host's own, reached by nobody else."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def refuse_what_is_open(config: zenoh.Config, source: str) -> None:
    """Raise SessionError where a configuration lets others than this host in, or goes out, without certificates."""
    mode = _get(config, "mode") or "peer"
    # What was asked for first: where a peer listens may follow from where it connects.
    for what in ("connect", "listen"):
        if what == "listen" and mode == "client":
            continue  # a client listens to nobody, whatever is configured
        for endpoint in _endpoints(_get(config, f"{what}/endpoints"), mode):
            protocol, _, address = endpoint.partition("/")
            host = re.sub(r":\d+(#.*)?$", "", address)
            if protocol in _WITHIN_HOST or (protocol not in _GUARDED and is_loopback(host)):
                continue
            if protocol not in _GUARDED:
                raise SessionError(
                    f"{source}: {what} {endpoint} reaches beyond this host without certificates: use tls/ and "
                    "zenoh.keys (`velod config keys`), or zenoh.insecure = true (--insecure) to be open to everyone "
                    "there"
                )
            _refuse_half_guarded(config, what, f"{source}: {what} {endpoint}")
    if _get(config, "scouting/multicast/enabled") is not False and mode != "client":
        raise SessionError(f"{source}: scouting.multicast must be disabled, or zenoh.insecure = true")


def _refuse_half_guarded(config: zenoh.Config, what: str, where: str) -> None:
    """TLS alone shows who the server is; mTLS shows who the other is, and the list says what it may do."""
    if _get(config, "transport/link/tls/enable_mtls") is not True:
        raise SessionError(f"{where}: transport.link.tls.enable_mtls must be true, or zenoh.insecure")
    access = _get(config, "access_control")
    if what == "listen" and not (access["enabled"] and access["default_permission"] == "deny"):
        raise SessionError(f"{where}: access_control must be enabled and deny by default, or zenoh.insecure = true")


def _endpoints(value: Any, mode: str) -> Iterator[str]:
    if isinstance(value, dict):
        value = value.get(mode)
    for entry in value or []:
        yield from [entry] if isinstance(entry, str) else entry


def _get(config: zenoh.Config, key: str) -> Any:
    return json.loads(config.get_json(key))
