"""``velod router``, ``velod relay``, ``velod config keys`` and ``velod config topology``: velod on networks."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from velod.cli.config import settings_of
from velod.cli.values import host, not_negative, port, positive, rig_name

if TYPE_CHECKING:
    from velod.cli.place import Way

LOCAL = "tcp/127.0.0.1:17447"
TOPOLOGIES = ("local", "robot", "fleet", "remote")
_ROLES = ("driver", "worker", "consumer", "operator")


def add_guard_options(parser: argparse.ArgumentParser) -> None:
    """How to reach, or be reached by, other hosts."""
    parser.add_argument("--keys", metavar="DIR", help="certificates for tls/ endpoints (`velod config keys`)")
    parser.add_argument(
        "--insecure", action="store_true", help="allow tcp/ beyond this host, open to all who can reach it"
    )


def add_way_options(parser: argparse.ArgumentParser) -> None:
    """The way to a running velod."""
    parser.add_argument("--connect", metavar="ENDPOINT", help=f"where velod runs (default {LOCAL})")
    parser.add_argument("--rig", metavar="NAME", help="name of the rig (default rig0); '*': all rigs")
    parser.add_argument("--role", choices=_ROLES, help="whose certificate to show at a tls/ endpoint")
    add_guard_options(parser)


def way_of(args: argparse.Namespace) -> Way:
    """What was said of the way."""
    from velod.cli.place import Way

    return Way(args.connect, args.rig, args.keys, args.role, args.insecure)


def add_router_options(parser: argparse.ArgumentParser) -> None:
    """What a router needs to know; the settings file may say it as well."""
    parser.add_argument("--port", type=port, help="on loopback (default zenoh.port, 17447)")
    parser.add_argument("--listen", metavar="ENDPOINT", help="where other hosts connect: tls/0.0.0.0:17448")
    parser.add_argument("--connect", metavar="ENDPOINT", help="another router to link to, tls/host:17448")
    parser.add_argument("--zenoh", metavar="FILE", help="a zenoh configuration (JSON5) instead of the above")
    parser.add_argument(
        "--rig", type=rig_name, action="append", default=[], metavar="NAME",
        help="a rig with certificates of its own; repeatable",
    )  # fmt: skip
    add_guard_options(parser)


def add_relay_options(parser: argparse.ArgumentParser) -> None:
    """From where, to where, how often."""
    parser.add_argument("--to", metavar="ENDPOINT", required=True, help="the other network's router")
    parser.add_argument("--to-keys", metavar="DIR", help="certificates for it, if they are not those of --keys")
    parser.add_argument(
        "--to-role", choices=_ROLES, default="worker", help="as whom to publish there (default worker)"
    )
    parser.add_argument("--hz", type=positive, default=1.0, help="velocities per second and rig (default 1)")
    add_way_options(parser)
    parser.set_defaults(rig="*")


def add_config_actions(keys: argparse.ArgumentParser, topology: argparse.ArgumentParser) -> None:
    """The options of ``velod config keys`` and ``velod config topology``."""
    keys.add_argument("folder", metavar="DIR", help="where to write; a CA that is there already signs")
    keys.add_argument(
        "--host", type=host, action="append", default=[], metavar="NAME",
        help="name or address of the server; repeatable",
    )  # fmt: skip
    keys.add_argument("--days", type=positive, default=365.0, help="for which certificates are valid (default 365)")
    keys.set_defaults(command=_keys)
    topology.add_argument("name", choices=TOPOLOGIES, metavar="NAME", help=", ".join(TOPOLOGIES))
    topology.add_argument("-o", "--output", default=".", metavar="DIR", help="where to write (default here)")
    topology.add_argument("--host", type=host, default="velod.local", help="the router, as others reach it")
    topology.add_argument("--keys", default="/etc/velod/keys", metavar="DIR", help="certificates on each host")
    topology.add_argument(
        "--max-hz", type=not_negative, default=0.0, help="remote: velocities per second and rig; 0: all"
    )
    topology.set_defaults(command=_topology)
    for parser in (keys, topology):
        parser.add_argument(
            "--rig", type=rig_name, action="append", default=[], metavar="NAME",
            help="a rig with its own certificates; repeatable",
        )  # fmt: skip


def router(args: argparse.Namespace) -> int:
    """Route until SIGINT or SIGTERM."""
    from velod.runtime.router import run_router
    from velod.runtime.worker import start_logging, stop_on_signals

    zenoh = settings_of(args.config).zenoh
    zenoh = replace(
        zenoh,
        port=args.port or zenoh.port,
        listen=args.listen or zenoh.listen,
        connect=args.connect or zenoh.connect,
        keys=args.keys or zenoh.keys,
        config=args.zenoh or zenoh.config,
        insecure=args.insecure or zenoh.insecure,
    )
    start_logging("router")
    run_router(zenoh, args.rig, stop_on_signals())
    return 0


def relay(args: argparse.Namespace) -> int:
    """Pass velocities on until SIGINT or SIGTERM."""
    from velod.cli.place import place_of
    from velod.config import ZenohSettings
    from velod.relay import relay as run
    from velod.runtime.endpoints import parse
    from velod.runtime.worker import start_logging, stop_on_signals

    if args.hz > 1000.0:
        raise ValueError(f"--hz {args.hz:g}: must be at most 1000")
    parse(args.to, "--to")
    place = place_of(args.config, way_of(args), "consumer")
    keys = args.to_keys or place.zenoh.keys
    target = ZenohSettings(connect=args.to, keys=keys, role=args.to_role, insecure=place.zenoh.insecure)
    start_logging("relay")
    run(place.zenoh, target, place.rig, args.hz, stop_on_signals())
    return 0


def _keys(args: argparse.Namespace) -> int:
    try:
        from velod.runtime.certificates import make_keys
    except ImportError:
        raise ValueError("certificates need the package cryptography: pip install 'velod[keys]'") from None
    for path in make_keys(args.folder, args.host, args.rig, args.days):
        print(f"wrote {path}")
    ca_key = Path(args.folder) / "ca.key"
    print(f"give each host ca.pem and the pair of its role; {ca_key} signs them all: keep it off every one of them")
    return 0


def _topology(args: argparse.Namespace) -> int:
    from velod.runtime.topology import Site, write

    site = Site(args.host, str(Path(args.keys)), tuple(args.rig), args.max_hz)
    for path in write(args.name, site, args.output):
        print(f"wrote {path}")
    return 0
