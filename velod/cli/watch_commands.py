"""What looks at a running velod: ``velod echo``, ``top``, ``view``, ``record``, ``odometry``."""

from __future__ import annotations

import argparse

from velod.cli.network import way_of
from velod.cli.options import Commands, add_watch_options, command
from velod.cli.values import count, port, positive


def add_commands(commands: Commands) -> None:
    """Their parsers."""
    for add in (_add_echo, _add_top, _add_view, _add_record, _add_odometry):
        add(commands)


def _add_echo(commands: Commands) -> None:
    parser = command(
        commands,
        "echo",
        _echo,
        "Print messages as they come.",
        "Topics: velocity, odometry, health; events, imu_sensor (from the driver); batch_flow, batch_depth, flow,\n"
        "depth, imu, done (between the processes). Arrays are shown by shape and range.",
        "  velod echo                            velocities of the velod on this host\n"
        "  velod echo health -n 4                four health messages, then stop\n"
        "  velod echo velocity --connect tls/10.0.0.5:17448 --keys /etc/velod/keys\n"
        "  velod echo --rig '*'                  velocities of all rigs, each with its rig's name",
    )
    parser.add_argument("topic", nargs="?", default="velocity", metavar="TOPIC")
    add_watch_options(parser)
    parser.add_argument("-n", "--count", type=count, metavar="N", help="stop after N messages")
    parser.add_argument(
        "--timeout", type=positive, metavar="S", help="give up after S seconds without a message (default: never)"
    )


def _add_top(commands: Commands) -> None:
    parser = command(
        commands,
        "top",
        _top,
        "A live table of the processes: rates, latency, drops, gaps, alarms.",
        "From the health message that every process sends once a second, and from who is alive.",
        "  velod top\n"
        "  velod top --once                      one table, for a log; exits with 1 if nobody answers\n"
        "  velod top --connect tls/10.0.0.5:17448 --keys /etc/velod/keys --rig drone",
    )
    add_watch_options(parser)
    parser.add_argument("--once", action="store_true", help="print one table and stop")


def _add_view(commands: Commands) -> None:
    parser = command(
        commands,
        "view",
        _view,
        "Selected events, flow, depth and velocity in the Rerun viewer.",
        "Needs the extra 'view' (rerun-sdk). The viewer listens on loopback only, its analytics are off. The\n"
        "timeline is the sensor's time. What is faint is unsure; velocities have a band of three sigmas.",
        "  velod view                            the velod on this host, live\n"
        "  velod view --save run.rrd --seconds 10\n"
        "                                        into a file, for rerun run.rrd",
    )
    add_watch_options(parser)
    parser.add_argument("--save", metavar="FILE", help="write a recording for the viewer instead of opening it")
    parser.add_argument("--seconds", type=positive, metavar="S", help="stop after S seconds (default: never)")
    parser.add_argument("--port", type=port, default=9876, help="of the viewer on loopback (default 9876)")


def _add_record(commands: Commands) -> None:
    parser = command(
        commands,
        "record",
        _record,
        "What a rig sends, into a file, until Ctrl-C.",
        "The suffix says which kind. FILE.h5 takes the sensor streams (events of both cameras, IMU), 13 bytes an\n"
        "event, for `velod replay` and `velod eval`; it appears when the recording ends. Cameras that are not equal\n"
        "and aligned do not fit into it: their calibration is written beside it. FILE.mcap takes topics (velocity,\n"
        "odometry and health unless named): small messages as JSON, which Foxglove and PlotJuggler show, others as\n"
        "msgpack (docs/messages.md); it needs pip install 'velod[mcap]'. Exits with 1 where messages are missing,\n"
        "which it counts by their seq, or the disk got full.",
        "  velod record run.h5                   the sensors of the velod on this host; then velod replay run.h5\n"
        "  velod record run.mcap --seconds 60    velocity, odometry and health, for a minute\n"
        "  velod record run.mcap velocity flow depth\n"
        "                                        these topics\n"
        "  velod record run.mcap --connect tls/10.0.0.5:17448 --keys /etc/velod/keys\n"
        "                                        of a velod on another host",
    )
    parser.add_argument("file", metavar="FILE", help="*.h5: sensor streams; *.mcap: topics; must not exist yet")
    parser.add_argument("topics", nargs="*", default=[], metavar="TOPIC", help="as for velod echo; with .mcap only")
    add_watch_options(parser)
    parser.add_argument("--calibration", metavar="FILE", help="to put into the file, instead of the service's own")
    parser.add_argument("--seconds", type=positive, metavar="S", help="stop after S seconds (default: never)")


def _add_odometry(commands: Commands) -> None:
    parser = command(
        commands,
        "odometry",
        _odometry,
        "Begin the dead reckoning anew: position zero, heading zero.",
        "A query on velod/<rig>/odometry/reset does the same, in any language. What comes out: velod echo odometry.",
        "  velod odometry reset\n"
        "  velod odometry reset --connect tls/10.0.0.5:17448 --keys /etc/velod/keys --rig drone",
    )
    parser.add_argument("action", choices=("reset",), help="what to do")
    add_watch_options(parser)


def _echo(args: argparse.Namespace) -> int:
    from velod.cli.watch import echo

    return echo(args.config, args.topic, way_of(args), args.count, args.timeout)


def _top(args: argparse.Namespace) -> int:
    from velod.cli.top import top

    return top(args.config, way_of(args), once=args.once)


def _view(args: argparse.Namespace) -> int:
    from velod.cli.view import view

    return view(args.config, way_of(args), args.save, args.seconds, args.port)


def _record(args: argparse.Namespace) -> int:
    from velod.cli.record import record

    return record(args.config, args.file, args.topics, way_of(args), args.calibration, args.seconds)


def _odometry(args: argparse.Namespace) -> int:
    from velod.cli.watch import reset_odometry

    return reset_odometry(args.config, way_of(args))
