"""What is claimed, measured here: ``velod bench``, ``velod prove``."""

from __future__ import annotations

import argparse
import os

from velod.cli import prove
from velod.cli.options import Commands, command, plain

_BENCHES = ("all", "flow", "depth", "solve", "codec", "pipeline", "hop", "latency", "rate")


def add_commands(commands: Commands) -> None:
    """Their parsers."""
    for add in (_add_bench, _add_prove):
        add(commands)


def _add_bench(commands: Commands) -> None:
    parser = command(
        commands,
        "bench",
        _bench,
        "How long each part takes on this machine, beside a peer.",
        "On one core, on simulated input, as medians; peers (numpy, OpenCV, pickle) run in the same process. Close\n"
        "what else computes first.",
        "  velod bench                           everything, in about a minute\n"
        "  velod bench solve --json out.json     the optimizer alone; the numbers into a file\n"
        "  velod bench latency                   through all processes: where a batch's time goes, p50 and p99\n"
        "  velod bench rate                      real time, at 16 and 20 M events/s, on three sizes of sensor",
    )
    parser.add_argument(
        "group", nargs="?", default="all", choices=_BENCHES, metavar="GROUP", help=", ".join(_BENCHES)
    )
    parser.add_argument("--json", metavar="OUT", help="write the results; - for stdout")


def _add_prove(commands: Commands) -> None:
    parser = plain(
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

    prove.add_actions(action)


def _bench(args: argparse.Namespace) -> int:
    # Before numpy is loaded: with threads the peers would be measured on all cores, and velod is on one.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from velod.cli.bench import bench

    return bench(args.group, args.json)
