"""A Zenoh router as a process of velod's own: where hosts or rigs meet, and where certificates are asked for."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from threading import Event

import zenoh

from velod.config import ZenohSettings
from velod.runtime.access import SERVER
from velod.runtime.endpoints import parse, refuse_what_is_open
from velod.runtime.session import key_files, load_config, open_config, router_tree, to_config

log = logging.getLogger("velod.router")

_REPORT_S = 60.0


def router_config(settings: ZenohSettings, rigs: Sequence[str] = ()) -> zenoh.Config:
    """Of a router on loopback (``port``) and ``listen``, linked to the router at ``connect``.

    ``zenoh.config`` replaces all that. ``rigs``: whose own certificates are known. Raises SessionError,
    CertificateError.
    """
    if settings.config:
        config = load_config(settings.config)
    else:
        listens = [f"tcp/127.0.0.1:{settings.port}", *([settings.listen] if settings.listen else [])]
        connects = [settings.connect] if settings.connect else []
        files = None
        for name, endpoint, role in (
            ("listen", settings.listen, SERVER),
            ("connect", settings.connect, settings.role),
        ):
            if endpoint and parse(endpoint, f"zenoh.{name}").is_guarded:
                files = key_files(settings, role)
        config = to_config(router_tree(listens, connects, files, rigs, settings.role))
    if not settings.insecure:
        refuse_what_is_open(config, settings.config or "zenoh")
    return config


def run_router(settings: ZenohSettings, rigs: Sequence[str], stop: Event) -> None:
    """Route until ``stop`` is set. Raises SessionError, CertificateError."""
    with open_config(router_config(settings, rigs), settings, introducer=True) as session:
        log.info("up")
        while not stop.wait(_REPORT_S):
            info = session.info
            log.info("%d processes, %d routers", len(info.peers_zid()), len(info.routers_zid()))
