"""What runs and judges recordings: ``velod demo``, ``replay``, ``eval``, ``sim``."""

from __future__ import annotations

import argparse
import os
from typing import TYPE_CHECKING

from velod.cli.options import Commands, add_config_option, command
from velod.cli.sim import add_options as add_sim_options
from velod.cli.values import count, positive, seed, speed

if TYPE_CHECKING:
    from velod.cli.play import PlayOptions


_SEQUENCES = "corridor-1..3, boxes-4..5, spin-1..3 (Table I of the paper)"

_HELD_OUT = "walk-1 (in the hand, with stops), flip-1 (starts upside down), hover-1 (dashes, hovers and turns)"


def add_commands(commands: Commands) -> None:
    """Their parsers."""
    for add in (_add_demo, _add_replay, _add_eval, _add_sim):
        add(commands)


def _add_demo(commands: Commands) -> None:
    parser = command(
        commands,
        "demo",
        _demo,
        "Simulated sensors through the whole service, judged against the truth.",
        "Simulates a stereo event camera and an IMU on their way through a corridor (it is kept in ~/.cache/velod),\n"
        "plays that in real time from a driver process of its own, as a camera would, and ends with the error\n"
        "against the simulated truth, rate, latency and what was dropped. It takes half a minute on two\n"
        "cores, half of it the simulation, which the next run finds kept. Exits with 1 where the error exceeds\n"
        "0.1 m/s (spins: 0.2 m/s), or velocities are missing or not valid.",
        "  velod demo                              5 s at 5.7 m/s along the corridor\n"
        "  velod demo --seconds 20 --csv out.csv   longer; every velocity into a file\n"
        "  velod demo --sequence boxes-4           a room of boxes instead",
    )
    add_config_option(parser)
    parser.add_argument("--seconds", type=positive, default=5.0, help="of sensor time (default 5)")
    parser.add_argument("--sequence", default="corridor-1", help=f"{_SEQUENCES} (default corridor-1)")
    parser.add_argument("--seed", type=seed, default=1, help="of the simulated noise (default 1)")
    parser.add_argument("--csv", metavar="OUT", help="write every velocity")
    parser.add_argument("--json", metavar="OUT", help="write the result; - for stdout")


def _add_replay(commands: Commands) -> None:
    parser = command(
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


def _add_eval(commands: Commands) -> None:
    parser = command(
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
        "  velod eval --table synthetic --quick        the paper's tables on simulated sequences, in three minutes\n"
        "  velod eval --table synthetic --report page/ the same in full, in a quarter of an hour\n"
        "  velod eval --table held-out --texture 5     other motions, other leaves",
    )
    parser.add_argument("files", nargs="*", metavar="FILE", help="recordings that hold the truth")
    _add_play_options(parser)
    parser.add_argument("--json", metavar="OUT", help="write the results; - for stdout")
    parser.add_argument(
        "--report", metavar="DIR", help="compare with the baselines, offline; write report.html and pictures"
    )
    parser.add_argument(
        "--markdown", metavar="FILE", help="put the tables into a Markdown file, between its marks for this command"
    )
    _add_file_options(parser)
    _add_table_options(parser)


def _add_file_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("with recordings")
    group.add_argument("--plot", metavar="DIR", help="write pictures")
    group.add_argument(
        "--floor", action="store_true", help="also what perfect flow and depth would give (simulated recordings only)"
    )
    group.add_argument(
        "--stages",
        action="store_true",
        help="judge flow and depth alone, offline, against true motion and depth: by distance, edge direction, ...",
    )


def _add_table_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("instead of recordings")
    group.add_argument(
        "--table",
        choices=("synthetic", "held-out"),
        help="simulate the sequences of Table I, or those that no setting was chosen on (kept), and judge velod and "
        "its baselines beside the paper; what is done is kept: a run that was cut short goes on",
    )
    group.add_argument("--quick", action="store_true", help="a second of each, one IMU noise")
    group.add_argument("--seed", type=seed, help="of the events' noise (default 1)")
    group.add_argument("--texture", type=seed, metavar="SEED", help="other leaves on walls and boxes")
    group.add_argument("--jobs", type=count, metavar="N", help="processes (default: cores)")


def _add_sim(commands: Commands) -> None:
    parser = command(
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
        "  velod sim spin-2 -o smooth.h5 --rays 2 --seconds 1\n"
        "  velod sim corridor-1 -o lens.h5 --distortion=-0.35,0.15,0,0,0",
    )
    parser.add_argument("sequence", metavar="SEQUENCE")
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="HDF5 file to write")
    parser.add_argument("--seconds", type=positive, default=5.0, help="of sensor time (default 5)")
    parser.add_argument("--seed", type=seed, default=1, help="of the noise (default 1)")
    add_sim_options(parser)


def _add_play_options(parser: argparse.ArgumentParser) -> None:
    add_config_option(parser)
    parser.add_argument(
        "--calibration",
        metavar="FILE",
        help="instead of rig.calibration and of the recording's own (velod, Kalibr, ROS)",
    )
    parser.add_argument("--offline", action="store_true", help="in one process, as fast as it goes; the same numbers")
    parser.add_argument(
        "--speed",
        type=speed,
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


def _demo(args: argparse.Namespace) -> int:
    from velod.cli.simulated import demo

    return demo(args.config, args.sequence, args.seconds, args.seed, args.csv, args.json)


def _replay(args: argparse.Namespace) -> int:
    from velod.cli.play import replay

    return replay(args.config, args.file, _play_options(args), args.csv)


def _eval(args: argparse.Namespace) -> int:
    _require_what_goes_together(args)
    if args.table is not None:
        from velod.cli.compare import Output, TableOptions, compare_sequences

        seed, processes = 1 if args.seed is None else args.seed, args.jobs or os.cpu_count() or 1
        options = TableOptions(args.table, args.quick, seed, args.texture, processes)
        return compare_sequences(args.config, options, Output(args.json, args.report, args.markdown))
    if args.stages:
        from velod.cli.stages import judge_stages

        return judge_stages(args.config, args.files, args.json, args.calibration)
    if args.report is not None or args.markdown is not None:
        from velod.cli.compare import Output, compare_files

        return compare_files(args.config, args.files, Output(args.json, args.report, args.markdown), args.calibration)
    from velod.cli.play import evaluate_files

    return evaluate_files(args.config, args.files, _play_options(args), args.json, args.plot, floor=args.floor)


def _require_what_goes_together(args: argparse.Namespace) -> None:
    """Raise ValueError for options of ``velod eval`` that would have no effect."""
    if args.files and args.table is not None:
        raise ValueError("--table simulates its own recordings: give it or files, not both")
    with_table = {"--quick": args.quick, "--seed": args.seed, "--texture": args.texture, "--jobs": args.jobs}
    with_files = {
        "--calibration": args.calibration,
        "--plot": args.plot,
        "--floor": args.floor,
        "--stages": args.stages,
    }
    for option, value in (with_table if args.table is None else with_files).items():
        if value is not None and value is not False:
            where = "--table" if args.table is None else "recordings; --table simulates its own"
            raise ValueError(f"{option} goes with {where}")
    if not args.files and args.table is None:
        raise ValueError("what is to be judged? Give recordings, or --table synthetic")
    if args.stages and args.report is not None:
        raise ValueError("--stages goes with recordings alone; --table and --report hold it")
    if args.stages and (args.plot is not None or args.floor):
        raise ValueError("--stages judges flow and depth alone: --plot and --floor speak of velocities")


def _sim(args: argparse.Namespace) -> int:
    from velod.cli.sim import recipe_of
    from velod.cli.simulated import simulate_to_file

    return simulate_to_file(recipe_of(args), args.output, args.seconds, args.seed)


def _play_options(args: argparse.Namespace) -> PlayOptions:
    from velod.cli.play import PlayOptions

    return PlayOptions(args.offline, args.speed, args.packets, args.calibration)
