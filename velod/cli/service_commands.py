"""What runs, prepares and connects the service: ``velod run``, ``doctor``, ``config``, ``router``, ..."""

from __future__ import annotations

import argparse

from velod.cli import network
from velod.cli.options import Commands, add_config_option, add_watch_options, command, plain


def add_commands(commands: Commands) -> None:
    """Their parsers."""
    for add in (_add_run, _add_doctor, _add_config, _add_warmup, _add_router, _add_relay):
        add(commands)


def _add_run(commands: Commands) -> None:
    parser = command(
        commands,
        "run",
        _run,
        "The service beside a sensor driver: ingest, flow, depth, optimizer.",
        "Starts the processes, starts dead ones again, and ends them all on Ctrl-C or SIGTERM. A driver publishes\n"
        "velod/<rig>/sensor/events/<left|right> and velod/<rig>/sensor/imu (docs/driver.md).",
        "  velod run --calibration rig.yaml              everything on this host, default settings\n"
        "  velod run -c velod.toml                       with your settings, rig.calibration among them\n"
        "  velod run --only flow --connect tcp/10.0.0.5:17447 --worker flow-1\n"
        "                                                one more flow worker, for a velod on 10.0.0.5\n"
        "  velod run -c velod.toml --only ingest,optimizer\n"
        "                                                only these here; flow and depth run elsewhere",
    )
    add_config_option(parser)
    parser.add_argument(
        "--calibration", metavar="FILE", help="of the rig (velod, Kalibr, ROS), instead of rig.calibration"
    )
    parser.add_argument("--only", type=_stages, metavar="STAGE[,STAGE]", help="only these stages on this host")
    parser.add_argument("--connect", metavar="ENDPOINT", help="join the velod there; settings come from it")
    parser.add_argument("--worker", metavar="NAME", help="name of the worker, with one stage in --only (flow-1)")
    network.add_guard_options(parser)


def _add_doctor(commands: Commands) -> None:
    parser = command(
        commands,
        "doctor",
        _doctor,
        "Whether this machine, this installation and these settings are fit for velod.",
        "A line for each thing: OK, WARN (it works, but ...) or FAIL, with what to do. Looks at Python and the\n"
        "packages, compiled kernels, processors, memory and shared memory, the clock, the calibration and the\n"
        "certificates that the settings name, and at the service, or its port. Changes nothing. Exits with 1 where\n"
        "something failed.",
        "  velod doctor                          after installing\n"
        "  velod doctor -c velod.toml            with your settings: calibration, port and certificates as well\n"
        "  velod doctor --connect tls/10.0.0.5:17448 --keys /etc/velod/keys\n"
        "                                        whether this host reaches the velod there\n"
        "  velod doctor --json -                 for a program",
    )
    add_watch_options(parser)
    parser.add_argument("--calibration", metavar="FILE", help="instead of rig.calibration")
    parser.add_argument("--json", metavar="OUT", help="write the findings; - for stdout")


def _add_config(commands: Commands) -> None:
    parser = plain(
        commands.add_parser,
        "config",
        help="Settings, calibration, networks: show, init, check, calibration, keys, topology.",
        description="Settings, calibration and network files. What is wrong is refused with file, key and reason.",
        epilog="""\
examples:
  velod config init velod.toml            all settings with their meaning and defaults
  velod config check velod.toml           whether velod would take it
  velod config show -c velod.toml         the settings in effect
  velod config calibration camchain.yaml  read a calibration (velod, Kalibr, ROS) and show it as velod's YAML
  velod config keys keys --host 10.0.0.5  a CA, and certificates for a server and for each role
  velod config topology fleet -o zenoh --host 10.0.0.5 --rig drone-1 --rig drone-2
                                          zenoh configurations: routers, rigs, consumers""",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)

    def action(name: str, what: str) -> argparse.ArgumentParser:
        return actions.add_parser(name, help=what, description=f"{what[0].upper()}{what[1:]}.")

    show = action("show", "print the settings in effect: the file's, and the defaults for the rest")
    add_config_option(show)
    show.set_defaults(command=_config_show)
    init = action("init", "write all settings with their meaning and defaults")
    init.add_argument("file", metavar="FILE", nargs="?", default="velod.toml", help="default velod.toml")
    init.add_argument("--force", action="store_true", help="overwrite an existing file")
    init.set_defaults(command=_config_init)
    check = action("check", "say whether velod would take a settings file, and the calibration that it names")
    check.add_argument("file", metavar="FILE")
    check.set_defaults(command=_config_check)
    calibration = action("calibration", "read a calibration and show it as velod's YAML")
    calibration.add_argument(
        "file", metavar="FILE", help="velod's own, Kalibr's camchain, or the left.yaml of a ROS pair"
    )
    calibration.add_argument("imu", nargs="?", metavar="IMU", help="Kalibr: file with T_cam_imu, where it is another")
    calibration.set_defaults(command=_config_calibration)
    network.add_config_actions(
        keys=action("keys", "make a CA, and certificates for a server and for each role"),
        topology=action("topology", "write zenoh configurations for a kind of network"),
    )


def _add_warmup(commands: Commands) -> None:
    command(
        commands,
        "warmup",
        _warmup,
        "Compile the numerical kernels now, so that the first run need not.",
        "Those of the stages and of the simulator; half a minute to a minute the first time. What was\n"
        "compiled is kept beside the package, or under NUMBA_CACHE_DIR.",
        "  velod warmup                          after installing, or when building an image",
    )


def _add_router(commands: Commands) -> None:
    parser = command(
        commands,
        "router",
        network.router,
        "A Zenoh router: where hosts or rigs meet.",
        "Routes between this host's processes (loopback), other hosts (--listen) and another router (--connect).\n"
        "Who comes from outside shows a certificate and may do what its role may.",
        "  velod router --listen tls/0.0.0.0:17448 --keys /etc/velod/keys\n"
        "  velod router --connect tls/site.example:17448 --keys /etc/velod/keys\n"
        "                                        on a rig: its velocity goes up to the site's router\n"
        "  velod router --zenoh fleet-router.json5\n"
        "                                        as `velod config topology fleet` wrote it",
    )
    add_config_option(parser)
    network.add_router_options(parser)


def _add_relay(commands: Commands) -> None:
    parser = command(
        commands,
        "relay",
        network.relay,
        "Velocities from one network to another, the newest of each rig so often.",
        "A client of both: of a site's router, where the rigs are, and of one further up. Nothing else crosses, and\n"
        "neither network learns of the other's routers. seq counts anew; the times of publication stay, so ages are\n"
        "true where the clocks agree.",
        "  velod relay --connect tls/site-a:17448 --keys site-keys --to tls/top.example:17448 --to-keys top-keys\n"
        "                                        one velocity a second of every rig of the site\n"
        "  velod relay --rig drone --hz 10 --to tls/top.example:17448 --to-keys top-keys\n"
        "                                        of one rig, of the velod on this host",
    )
    add_config_option(parser)
    network.add_relay_options(parser)


def _stages(text: str) -> list[str]:
    known = ("ingest", "flow", "depth", "optimizer")
    stages = text.split(",")
    for stage in stages:
        if stage not in known:
            raise argparse.ArgumentTypeError(f"no stage {stage!r}; stages: {', '.join(known)}")
    return stages


def _run(args: argparse.Namespace) -> int:
    from velod.cli.run import run

    return run(args.config, args.calibration, args.only, args.connect, args.worker, args.keys, insecure=args.insecure)


def _doctor(args: argparse.Namespace) -> int:
    from velod.cli.doctor import doctor

    return doctor(args.config, args.calibration, network.way_of(args), args.json)


def _warmup(args: argparse.Namespace) -> int:
    from velod.cli.run import warmup

    return warmup()


def _config_show(args: argparse.Namespace) -> int:
    from velod.cli.config import show

    return show(args.config)


def _config_init(args: argparse.Namespace) -> int:
    from velod.cli.config import init

    return init(args.file, force=args.force)


def _config_check(args: argparse.Namespace) -> int:
    from velod.cli.config import check

    return check(args.file)


def _config_calibration(args: argparse.Namespace) -> int:
    from velod.cli.config import calibration

    return calibration(args.file, args.imu)
