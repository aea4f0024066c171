"""``velod prove``: what velod claims of hostile networks, load and time, tried out on this machine."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from typing import Any

from velod.cli_exit import RunFailed


def add_actions(actions: Any) -> None:
    """The parsers of ``velod prove ...``; ``actions(name, what)`` makes one."""
    attacks = actions("attacks", "try what outsiders may try on a velod at work; a table of what happened")
    attacks.set_defaults(command=_attacks)
    fuzz = actions("fuzz", "give every decoder bad inputs that a coverage-guided fuzzer makes (atheris)")
    fuzz.add_argument("--runs", type=int, default=100_000, help="inputs, over all decoders (default 100000)")
    fuzz.add_argument("--seed", type=int, default=1, help="of the inputs (default 1)")
    fuzz.add_argument("--corpus", metavar="DIR", help="where to begin from, and to keep inputs that were of interest")
    fuzz.set_defaults(command=_fuzz)
    fleet = actions("fleet", "many simulated rigs through one router to one consumer: rate, latency, CPU")
    fleet.add_argument("--rigs", type=int, default=100, help="how many (default 100)")
    fleet.add_argument("--hz", type=float, default=75.0, help="velocities per second of each (default 75)")
    fleet.add_argument("--seconds", type=float, default=10.0, help="default 10")
    fleet.add_argument("--tls", action="store_true", help="with certificates, as between hosts")
    fleet.set_defaults(command=_fleet)
    soak = actions(
        "soak", "a velod at work for long, its workers killed and stopped at random: memory, files, latency"
    )
    soak.add_argument("--seconds", type=float, default=1800.0, help="default 1800")
    soak.add_argument("--fault-every", type=float, default=20.0, metavar="S", help="on average (default 20)")
    soak.add_argument("--seed", type=int, default=1, help="of the faults (default 1)")
    soak.set_defaults(command=_soak)
    for parser in (attacks, fuzz, fleet, soak):
        parser.add_argument("--json", metavar="OUT", help="write what was seen; - for stdout")


def _attacks(args: argparse.Namespace) -> int:
    """Raises RunFailed where an attempt passed or something died."""
    from velod.cli_report import write_json
    from velod.prove.attacks import besiege
    from velod.prove.besieged import SiegeError
    from velod.sim import simulated_recording

    try:
        siege = besiege(simulated_recording("corridor-1", 5.0, seed=1), speed=0.5)
    except SiegeError as e:
        raise RunFailed(str(e)) from None
    out = sys.stderr if args.json == "-" else sys.stdout
    print("| attempt | by | what happened |\n|---|---|---|", file=out)
    for o in siege.outcomes:
        print(f"| {o.attempt} | {o.holder} | {o.happened}{'' if o.repelled else ' **PASSED**'} |", file=out)
    growth = ", ".join(f"{worker} {mib:+.0f}" for worker, mib in sorted(siege.growth_mib.items()))
    print(
        f"\nvelocities at the consumer meanwhile: {siege.served}, at the most {siege.longest_gap_s:.2f} s apart;"
        f" died: {', '.join(siege.died) or 'nobody'}; memory, MiB: {growth}",
        file=out,
    )
    if args.json is not None:
        write_json(args.json, asdict(siege))
    if failures := siege.failures():
        raise RunFailed("; ".join(failures))
    return 0


def _fuzz(args: argparse.Namespace) -> int:
    """Raises RunFailed where a decoder raised what it must not, or took memory without limit."""
    from velod.cli_report import write_json
    from velod.prove.fuzz import SHARES, FuzzError, fuzz

    results = []
    out = sys.stderr if args.json == "-" else sys.stdout
    for decoder, share in SHARES.items():
        try:
            result = fuzz(decoder, max(1, round(args.runs * share)), args.seed, args.corpus)
        except FuzzError as e:
            raise ValueError(str(e)) from None
        print(
            f"{decoder:<12} {result.inputs:>9} inputs in {result.seconds:.0f} s, {result.edges} edges,"
            f" {result.peak_mib} MiB at the most: {result.crash or 'good'}",
            file=out,
            flush=True,
        )
        results.append(result)
    if args.json is not None:
        write_json(args.json, [asdict(result) for result in results])
    if crashes := [f"{r.decoder}: {r.crash}" for r in results if r.crash]:
        raise RunFailed("; ".join(crashes))
    return 0


def _fleet(args: argparse.Namespace) -> int:
    """Raises RunFailed where more than a hundredth of the velocities did not come."""
    from velod.cli_report import write_json
    from velod.prove.fleet import FleetError, run_fleet

    try:
        fleet = run_fleet(args.rigs, args.hz, args.seconds, tls=args.tls)
    except FleetError as e:
        raise RunFailed(str(e)) from None
    print(
        f"{fleet.rigs} rigs at {fleet.hz:g} Hz: {fleet.rate_hz:.0f} velocities per second at the consumer"
        f" ({100 * fleet.share:.1f} %), {fleet.lost} lost, {fleet.silent} rigs not heard; latency p50"
        f" {fleet.latency_p50_ms:.2f} ms, p99 {fleet.latency_p99_ms:.2f} ms; cores: router {fleet.router_cores:.2f},"
        f" consumer {fleet.consumer_cores:.2f}, all rigs {fleet.rigs_cores:.2f}; router {fleet.router_mib:.0f} MiB",
        file=sys.stderr if args.json == "-" else sys.stdout,
    )
    if args.json is not None:
        write_json(args.json, asdict(fleet))
    if fleet.share < 0.99:
        raise RunFailed(f"{100 * fleet.share:.1f} % of the velocities came")
    return 0


def _soak(args: argparse.Namespace) -> int:
    """Raises RunFailed where memory, files or latency grow."""
    from velod.cli_report import write_json
    from velod.prove.besieged import SiegeError
    from velod.prove.soak import soak
    from velod.sim import simulated_recording

    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    try:
        recording = simulated_recording("corridor-1", 5.0, seed=1)
        result = soak(recording, args.seconds, args.fault_every, args.seed, say)
    except SiegeError as e:
        raise RunFailed(str(e)) from None
    out = sys.stderr if args.json == "-" else sys.stdout
    hits = ", ".join(f"{fault} {n} times" for fault, n in sorted(result.faults.items()))
    print(
        f"{result.seconds:.0f} s; faults: {hits or 'none'}; {result.served} valid velocities,"
        f" at the most {result.longest_gap_s:.2f} s apart; latency {result.latency_middle_ms:.1f} ms in the middle,"
        f" {result.latency_last_ms:.1f} ms in the end",
        file=out,
    )
    for p in result.processes:
        print(
            f"{p.worker:<14} {p.seconds:6.0f} s  {p.mib:6.1f} MiB, {p.files} files; in the last third"
            f" {p.growth_mib:+.2f} MiB ({p.slope_mib_h:+.2f} MiB/h), {p.new_files:+d} files;"
            f" for each death {p.death_mib:+.2f} MiB, {p.death_files:+.1f} files",
            file=out,
        )
    if args.json is not None:
        write_json(args.json, asdict(result))
    if failures := result.failures():
        raise RunFailed("; ".join(failures))
    return 0
