"""The command line: what people type. Each command loads what it needs, and only when it runs."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from velod import __version__, cli_network, cli_prove
from velod.cli_exit import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE, RunFailed
from velod.cli_sim import add_options as add_sim_options

if TYPE_CHECKING:
    from velod.cli_play import PlayOptions

LOCAL = "tcp/127.0.0.1:17447"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the exit code. What a user can put right is one line on stderr, never a traceback."""
    args = _parser().parse_args(argv)
    command: Callable[[argparse.Namespace], int] = args.command
    try:
        return command(args)
    except KeyboardInterrupt:
        print("velod: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # The reader of the pipe (head, less) has seen enough. Python's own flush at exit must not complain again.
        sys.stdout = None
        return 0
    except RunFailed as e:
        print(f"velod: failed: {_one_line(e)}", file=sys.stderr)
        return EXIT_FAILED
    except (ValueError, OSError) as e:
        # ConfigError, CalibrationError, RecordingError and SessionError are of these kinds.
        print(f"velod: error: {_one_line(e)}", file=sys.stderr)
        return EXIT_USAGE


def _one_line(e: Exception) -> str:
    if isinstance(e, OSError) and e.strerror and e.filename is not None:
        return f"{e.filename}: {e.strerror}"
    return " ".join(str(e).split()) or type(e).__name__


# --- the commands ---


def _demo(args: argparse.Namespace) -> int:
    from velod.cli_play import demo

    return demo(args.config, args.sequence, args.seconds, args.seed, args.csv, args.json)


def _run(args: argparse.Namespace) -> int:
    from velod.cli_run import run

    return run(args.config, args.calibration, args.only, args.connect, args.worker, args.keys, insecure=args.insecure)


def _replay(args: argparse.Namespace) -> int:
    from velod.cli_play import replay

    return replay(args.config, args.file, _play_options(args), args.csv)


def _eval(args: argparse.Namespace) -> int:
    if args.files and args.table is not None:
        raise ValueError("--table simulates its own recordings: give it or files, not both")
    if args.quick and (args.files or args.table is None):
        raise ValueError("--quick goes with --table synthetic")
    if args.stages and (args.table is not None or args.report is not None):
        raise ValueError("--stages goes with recordings alone; --table and --report hold it")
    if args.table is not None and args.calibration is not None:
        raise ValueError("--calibration goes with recordings: --table simulates its own")
    if args.table is not None:
        from velod.cli_compare import Output, TableOptions, compare_sequences

        options = TableOptions(args.table, args.quick, args.seed, args.texture, args.jobs)
        return compare_sequences(args.config, options, Output(args.json, args.report, args.markdown))
    if not args.files:
        raise ValueError("what is to be judged? Give recordings, or --table synthetic")
    if args.stages:
        from velod.cli_stages import judge_stages

        return judge_stages(args.config, args.files, args.json, args.calibration)
    if args.report is not None or args.markdown is not None:
        from velod.cli_compare import Output, compare_files

        return compare_files(args.config, args.files, Output(args.json, args.report, args.markdown), args.calibration)
    from velod.cli_play import evaluate_files

    return evaluate_files(args.config, args.files, _play_options(args), args.json, args.plot, floor=args.floor)


def _play_options(args: argparse.Namespace) -> PlayOptions:
    from velod.cli_play import PlayOptions

    return PlayOptions(args.offline, args.speed, args.packets, args.calibration)


def _sim(args: argparse.Namespace) -> int:
    from velod.cli_play import simulate_to_file
    from velod.cli_sim import recipe_of

    return simulate_to_file(recipe_of(args), args.output, args.seconds, args.seed)


def _odometry(args: argparse.Namespace) -> int:
    from velod.cli_watch import reset_odometry

    return reset_odometry(args.config, cli_network.way_of(args))


def _echo(args: argparse.Namespace) -> int:
    from velod.cli_watch import echo

    return echo(args.config, args.topic, cli_network.way_of(args), args.count, args.timeout)


def _top(args: argparse.Namespace) -> int:
    from velod.cli_watch import top

    return top(args.config, cli_network.way_of(args), once=args.once)


def _doctor(args: argparse.Namespace) -> int:
    from velod.cli_doctor import doctor

    return doctor(args.config, args.calibration, cli_network.way_of(args), args.json)


def _record(args: argparse.Namespace) -> int:
    from velod.cli_record import record

    return record(args.config, args.file, args.topics, cli_network.way_of(args), args.calibration, args.seconds)


def _view(args: argparse.Namespace) -> int:
    from velod.cli_view import view

    return view(args.config, cli_network.way_of(args), args.save, args.seconds, args.port)


def _config_show(args: argparse.Namespace) -> int:
    from velod.cli_config import show

    return show(args.config)


def _config_init(args: argparse.Namespace) -> int:
    from velod.cli_config import init

    return init(args.file, force=args.force)


def _config_check(args: argparse.Namespace) -> int:
    from velod.cli_config import check

    return check(args.file)


def _config_calibration(args: argparse.Namespace) -> int:
    from velod.cli_config import calibration

    return calibration(args.file, args.imu)


def _warmup(args: argparse.Namespace) -> int:
    from velod.cli_run import warmup

    return warmup()


def _bench(args: argparse.Namespace) -> int:
    # Before numpy is loaded: with threads the peers would be measured on all cores, and velod is on one.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from velod.cli_bench import bench

    return bench(args.group, args.json)


# --- the parser ---

_SEQUENCES = "corridor-1..3, boxes-4..5, spin-1..3 (Table I of the paper)"
_HELD_OUT = "walk-1 (in the hand, with stops), flip-1 (starts upside down), hover-1 (dashes, hovers and turns)"


def _parser() -> argparse.ArgumentParser:
    parser = _plain(
        argparse.ArgumentParser,
        prog="velod",
        description="Stereo events and an IMU in; metric body-frame velocity with its covariance out.",
        epilog="""\
first steps:
  velod demo                         see it run on simulated sensors, judged against the truth
  velod replay recording.h5          a recording through the same processes, in real time
  velod eval recording.h5 --offline  how good it is, where the recording holds the truth
  velod config init velod.toml       all settings, each with its meaning
  velod run -c velod.toml            the service beside a sensor driver
  velod echo                         what it says, from another terminal
`velod COMMAND --help` has worked examples for each command.""",
    )
    parser.add_argument("--version", action="version", version=f"velod {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in (
        _add_demo,
        _add_run,
        _add_replay,
        _add_eval,
        _add_sim,
        _add_echo,
        _add_odometry,
        _add_top,
        _add_record,
        _add_view,
        _add_doctor,
        _add_router,
        _add_relay,
        _add_config,
        _add_bench,
        _add_prove,
        _add_warmup,
    ):
        add(commands)
    return parser


_BENCHES = ("all", "flow", "depth", "solve", "codec", "pipeline", "hop")
_Commands = argparse._SubParsersAction  # argparse has no public name for it


def _plain(factory: Callable[..., argparse.ArgumentParser], *args: str, **kwargs: str) -> argparse.ArgumentParser:
    """A parser that keeps the line breaks of its texts."""
    return factory(*args, formatter_class=argparse.RawDescriptionHelpFormatter, **kwargs)


def _command(
    commands: _Commands[argparse.ArgumentParser],
    name: str,
    function: Callable[[argparse.Namespace], int],
    summary: str,
    text: str,
    examples: str,
) -> argparse.ArgumentParser:
    parser = _plain(
        commands.add_parser, name, help=summary, description=f"{summary}\n\n{text}", epilog=f"examples:\n{examples}"
    )
    parser.set_defaults(command=function)
    return parser


def _add_config_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-c", "--config", metavar="FILE", help="settings (TOML); `velod config init` writes one")


def _add_play_options(parser: argparse.ArgumentParser) -> None:
    _add_config_option(parser)
    parser.add_argument(
        "--calibration",
        metavar="FILE",
        help="instead of rig.calibration and of the recording's own (velod, Kalibr, ROS)",
    )
    parser.add_argument("--offline", action="store_true", help="in one process, as fast as it goes; the same numbers")
    parser.add_argument(
        "--speed",
        type=_speed,
        default=1.0,
        metavar="X|max",
        help="times real time (default 1); max: as fast as it goes without losing anything",
    )
    parser.add_argument(
        "--packets",
        default="200hz",
        metavar="HOW",
        help="how the driver cuts the stream: 200hz, 1000hz, 60hz, random, random:SEED (default 200hz)",
    )


def _add_watch_options(parser: argparse.ArgumentParser) -> None:
    _add_config_option(parser)
    cli_network.add_way_options(parser, LOCAL)


def _add_demo(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands,
        "demo",
        _demo,
        "Simulated sensors through the whole service, judged against the truth.",
        "Simulates a stereo event camera and an IMU on their way through a corridor (it is kept in ~/.cache/velod),\n"
        "plays that in real time from a driver process of its own, as a camera would, and ends with the error\n"
        "against the simulated truth, rate, latency and what was dropped. It takes half a minute on two\n"
        "cores, half of it the simulation, which the next run finds kept. Exits with 1 where the error exceeds\n"
        "0.1 m/s (spins: 0.2 m/s), or velocities are missing or not valid.",
        "  velod demo                            5 s at 5.7 m/s along the corridor\n"
        "  velod demo --seconds 20 --csv out.csv longer; every velocity into a file\n"
        "  velod demo --sequence boxes-4         a room of boxes instead",
    )
    _add_config_option(parser)
    parser.add_argument("--seconds", type=_seconds, default=5.0, help="of sensor time (default 5)")
    parser.add_argument("--sequence", default="corridor-1", help=f"{_SEQUENCES} (default corridor-1)")
    parser.add_argument("--seed", type=int, default=1, help="of the simulated noise (default 1)")
    parser.add_argument("--csv", metavar="OUT", help="write every velocity")
    parser.add_argument("--json", metavar="OUT", help="write the result; - for stdout")


def _add_run(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
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
    _add_config_option(parser)
    parser.add_argument(
        "--calibration", metavar="FILE", help="of the rig (velod, Kalibr, ROS), instead of rig.calibration"
    )
    parser.add_argument("--only", type=_stages, metavar="STAGE[,STAGE]", help="only these stages on this host")
    parser.add_argument("--connect", metavar="ENDPOINT", help="join the velod there; settings come from it")
    parser.add_argument("--worker", metavar="NAME", help="name of the worker, with one stage in --only (flow-1)")
    cli_network.add_guard_options(parser)


def _add_replay(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands,
        "replay",
        _replay,
        "A recording through the same processes that run beside a sensor.",
        "Reads velod's sequence files (HDF5), DSEC directories and the text format of the Event-Camera Dataset.",
        "  velod replay recording.h5                      in real time, with a live line\n"
        "  velod replay recording.h5 --speed max          as fast as it goes, nothing lost\n"
        "  velod replay recording.h5 --offline --csv v.csv\n"
        "                                                 in one process, every velocity into a file",
    )
    parser.add_argument("file", metavar="FILE", help="recording (file or directory)")
    _add_play_options(parser)
    parser.add_argument("--csv", metavar="OUT", help="write every velocity")


def _add_eval(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands,
        "eval",
        _eval,
        "Error against the truth in the file, and latency.",
        "AVE: mean of |v_gt - v_est| over every velocity from the first valid one on; RVE: the same, relative\n"
        "(Eq. 16). The estimator is given none of the truth. Exits with 1 where a file yields no valid velocity.",
        "  velod eval boxes.h5 --offline               a table\n"
        "  velod eval a.h5 b.h5 --offline --json -     a list of results as JSON on stdout\n"
        "  velod eval boxes.h5 --plot pictures/        velocity and error over time as PNG (needs velod[plot])\n"
        "  velod eval boxes.h5 --report page/          beside its baselines, as one HTML page with pictures\n"
        "  velod eval boxes.h5 --stages                how right flow and depth are, and their sigmas\n"
        "  velod eval --table synthetic --quick        the paper's tables on simulated sequences, in five minutes\n"
        "  velod eval --table synthetic --report page/ the same in full, in half an hour\n"
        "  velod eval --table held-out --texture 5     other motions, other leaves",
    )
    parser.add_argument("files", nargs="*", metavar="FILE", help="recordings that hold the truth")
    _add_play_options(parser)
    parser.add_argument("--json", metavar="OUT", help="write the results; - for stdout")
    parser.add_argument("--plot", metavar="DIR", help="write pictures")
    parser.add_argument(
        "--floor", action="store_true", help="also what perfect flow and depth would give (simulated recordings only)"
    )
    parser.add_argument(
        "--table",
        choices=("synthetic", "held-out"),
        help="simulate the sequences of Table I, or those that no setting was chosen on (kept), and judge velod and "
        "its baselines beside the paper; what is done is kept: a run that was cut short goes on",
    )
    parser.add_argument(
        "--stages",
        action="store_true",
        help="judge flow and depth alone, offline, against true motion and depth: by distance, edge direction, ...",
    )
    parser.add_argument("--quick", action="store_true", help="with --table: a second of each, one IMU noise")
    parser.add_argument("--seed", type=int, default=1, help="with --table: of the events' noise (default 1)")
    parser.add_argument("--texture", type=int, metavar="SEED", help="with --table: other leaves on walls and boxes")
    parser.add_argument(
        "--jobs",
        type=_count,
        default=os.cpu_count() or 1,
        metavar="N",
        help="with --table: processes (default: cores)",
    )
    parser.add_argument(
        "--markdown", metavar="FILE", help="put the tables into a Markdown file, between its marks for this command"
    )
    parser.add_argument(
        "--report", metavar="DIR", help="compare with the baselines, offline; write report.html and pictures"
    )


def _add_sim(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands,
        "sim",
        _sim,
        "Simulate a recording: stereo events, IMU, truth.",
        f"SEQUENCE: {_SEQUENCES};\n{_HELD_OUT}, which no setting was chosen on.",
        "  velod sim corridor-1 -o corridor.h5 --seconds 5\n"
        "  velod sim boxes-4 -o boxes.h5 --seed 7 && velod eval boxes.h5 --offline\n"
        "  velod sim boxes-4 -o rough.h5 --noise 1 --leak 0.1 --bandwidth 300 --jitter 20 --imu-hz 1000\n"
        "  velod sim hover-1 -o hover.h5 --texture 5 --seed 2\n"
        "  velod sim boxes-4 -o large.h5 --sensor 640x480 --seconds 1\n"
        "  velod sim corridor-1 -o lens.h5 --distortion=-0.35,0.15,0,0,0",
    )
    parser.add_argument("sequence", metavar="SEQUENCE")
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="HDF5 file to write")
    parser.add_argument("--seconds", type=_seconds, default=5.0, help="of sensor time (default 5)")
    parser.add_argument("--seed", type=int, default=1, help="of the noise (default 1)")
    add_sim_options(parser)


def _add_echo(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
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
    _add_watch_options(parser)
    parser.add_argument("-n", "--count", type=int, metavar="N", help="stop after N messages")
    parser.add_argument(
        "--timeout", type=_seconds, metavar="S", help="give up after S seconds without a message (default: never)"
    )


def _add_odometry(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands,
        "odometry",
        _odometry,
        "Begin the dead reckoning anew: position zero, heading zero.",
        "A query on velod/<rig>/odometry/reset does the same, in any language. What comes out: velod echo odometry.",
        "  velod odometry reset\n"
        "  velod odometry reset --connect tls/10.0.0.5:17448 --keys /etc/velod/keys --rig drone",
    )
    parser.add_argument("action", choices=("reset",), help="what to do")
    _add_watch_options(parser)


def _add_top(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands,
        "top",
        _top,
        "A live table of the processes: rates, latency, drops, gaps, alarms.",
        "From the health message that every process sends once a second, and from who is alive.",
        "  velod top\n"
        "  velod top --once                      one table, for a log; exits with 1 if nobody answers\n"
        "  velod top --connect tls/10.0.0.5:17448 --keys /etc/velod/keys --rig drone",
    )
    _add_watch_options(parser)
    parser.add_argument("--once", action="store_true", help="print one table and stop")


def _add_view(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
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
    _add_watch_options(parser)
    parser.add_argument("--save", metavar="FILE", help="write a recording for the viewer instead of opening it")
    parser.add_argument("--seconds", type=_seconds, metavar="S", help="stop after S seconds (default: never)")
    parser.add_argument("--port", type=int, default=9876, help="of the viewer on loopback (default 9876)")


def _add_record(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
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
    parser.add_argument("topics", nargs="*", metavar="TOPIC", help="as for velod echo; with .mcap only")
    _add_watch_options(parser)
    parser.add_argument("--calibration", metavar="FILE", help="to put into the file, instead of the service's own")
    parser.add_argument("--seconds", type=_seconds, metavar="S", help="stop after S seconds (default: never)")


def _add_doctor(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
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
    _add_watch_options(parser)
    parser.add_argument("--calibration", metavar="FILE", help="instead of rig.calibration")
    parser.add_argument("--json", metavar="OUT", help="write the findings; - for stdout")


def _add_router(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands,
        "router",
        cli_network.router,
        "A Zenoh router: where hosts or rigs meet.",
        "Routes between this host's processes (loopback), other hosts (--listen) and another router (--connect).\n"
        "Who comes from outside shows a certificate and may do what its role may.",
        "  velod router --listen tls/0.0.0.0:17448 --keys /etc/velod/keys\n"
        "  velod router --connect tls/site.example:17448 --keys /etc/velod/keys\n"
        "                                        on a rig: its velocity goes up to the site's router\n"
        "  velod router --zenoh fleet-router.json5\n"
        "                                        as `velod config topology fleet` wrote it",
    )
    _add_config_option(parser)
    cli_network.add_router_options(parser)


def _add_relay(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands,
        "relay",
        cli_network.relay,
        "Velocities from one network to another, the newest of each rig so often.",
        "A client of both: of a site's router, where the rigs are, and of one further up. Nothing else crosses, and\n"
        "neither network learns of the other's routers. seq counts anew; the times of publication stay, so ages are\n"
        "true where the clocks agree.",
        "  velod relay --connect tls/site-a:17448 --keys site-keys --to tls/top.example:17448 --to-keys top-keys\n"
        "                                        one velocity a second of every rig of the site\n"
        "  velod relay --rig drone --hz 10 --to tls/top.example:17448 --to-keys top-keys\n"
        "                                        of one rig, of the velod on this host",
    )
    _add_config_option(parser)
    cli_network.add_relay_options(parser, LOCAL)


def _add_config(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _plain(
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
    _add_config_option(show)
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
    cli_network.add_config_actions(
        keys=action("keys", "make a CA, and certificates for a server and for each role"),
        topology=action("topology", "write zenoh configurations for a kind of network"),
    )


def _add_bench(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands,
        "bench",
        _bench,
        "How long each part takes on this machine, beside a peer.",
        "On one core, on simulated input, as medians; peers (numpy, OpenCV, pickle) run in the same process. Close\n"
        "what else computes first.",
        "  velod bench                           everything, in about 20 s\n"
        "  velod bench solve --json out.json     the optimizer alone; the numbers into a file",
    )
    parser.add_argument(
        "group", nargs="?", default="all", choices=_BENCHES, metavar="GROUP", help=", ".join(_BENCHES)
    )
    parser.add_argument("--json", metavar="OUT", help="write the results; - for stdout")


def _add_prove(commands: _Commands[argparse.ArgumentParser]) -> None:
    parser = _plain(
        commands.add_parser,
        "prove",
        help="What is claimed of hostile networks, load and time, tried out here.",
        description="Each is a trial on this machine alone, over loopback, and ends with what it saw; exits with 1\n"
        "where that is not as claimed.",
        epilog="""\
examples:
  velod prove attacks                no certificate, forged velocity, floods, garbage, ...
  velod prove fuzz --runs 10000000   bad inputs for every decoder, in half an hour
  velod prove fleet --rigs 200       velocities of so many rigs through one router
  velod prove scaling                one, two and three flow workers where one is too slow
  velod prove soak --seconds 120     two minutes of faults; half an hour without the option""",
    )
    actions = parser.add_subparsers(title="trials", metavar="TRIAL", required=True)

    def action(name: str, what: str) -> argparse.ArgumentParser:
        return actions.add_parser(name, help=what, description=f"{what[0].upper()}{what[1:]}.")

    cli_prove.add_actions(action)


def _add_warmup(commands: _Commands[argparse.ArgumentParser]) -> None:
    _command(
        commands,
        "warmup",
        _warmup,
        "Compile the numerical kernels now, so that the first run need not.",
        "Those of the stages and of the simulator; half a minute to a minute the first time. What was\n"
        "compiled is kept beside the package, or under NUMBA_CACHE_DIR.",
        "  velod warmup                          after installing, or when building an image",
    )


# --- values ---


def _speed(text: str) -> float:
    """Times real time; infinity for ``max``."""
    if text == "max":
        return float("inf")
    return _seconds(text)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"not a number: {text!r}") from None
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be positive and finite, got {text}")
    return value


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 on, got {text!r}")
    return int(text)


def _stages(text: str) -> list[str]:
    known = ("ingest", "flow", "depth", "optimizer")
    stages = text.split(",")
    for stage in stages:
        if stage not in known:
            raise argparse.ArgumentTypeError(f"no stage {stage!r}; stages: {', '.join(known)}")
    return stages


if __name__ == "__main__":
    sys.exit(main())
