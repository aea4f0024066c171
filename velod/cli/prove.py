"""``velod prove``: what velod claims of hostile networks, load and time, tried out on this machine."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, TextIO

from velod.cli.exit import RunFailed
from velod.cli.values import count, not_negative, positive, seed


def add_actions(actions: Any) -> None:
    """The parsers of ``velod prove ...``; ``actions(name, what)`` makes one."""
    attacks = actions("attacks", "try what outsiders may try on a velod at work; a table of what happened")
    attacks.set_defaults(command=_attacks)
    fuzz = actions("fuzz", "give every decoder bad inputs that a coverage-guided fuzzer makes (atheris)")
    fuzz.add_argument("--runs", type=count, default=100_000, help="inputs, over all decoders (default 100000)")
    fuzz.add_argument("--seed", type=seed, default=1, help="of the inputs (default 1)")
    fuzz.add_argument("--corpus", metavar="DIR", help="where to begin from, and to keep inputs that were of interest")
    fuzz.set_defaults(command=_fuzz)
    fleet = actions("fleet", "many simulated rigs through one router to one consumer: rate, latency, CPU")
    fleet.add_argument("--rigs", type=count, default=100, help="how many (default 100)")
    fleet.add_argument("--hz", type=positive, default=75.0, help="velocities per second of each (default 75)")
    fleet.add_argument("--seconds", type=positive, default=10.0, help="default 10")
    fleet.add_argument("--tls", action="store_true", help="with certificates, as between hosts")
    fleet.set_defaults(command=_fleet)
    soak = actions(
        "soak", "a velod at work for long, its workers killed and stopped at random: memory, files, latency"
    )
    soak.add_argument("--seconds", type=positive, default=1800.0, help="default 1800")
    soak.add_argument("--fault-every", type=positive, default=20.0, metavar="S", help="on average (default 20)")
    soak.add_argument("--seed", type=seed, default=1, help="of the faults (default 1)")
    soak.set_defaults(command=_soak)
    scaling = actions("scaling", "throughput and latency against the number of flow workers; CPU and bytes by stage")
    scaling.add_argument("--workers", type=count, default=3, help="from 1 to so many (default 3)")
    scaling.add_argument(
        "--load-ms", type=not_negative, default=25.0, help="a flow worker sleeps so long on each batch (default 25)"
    )
    scaling.add_argument("--speed", type=positive, default=1.0, help="of playing, times real time (default 1)")
    scaling.add_argument("--seconds", type=positive, default=5.0, help="of corridor-1, simulated once (default 5)")
    scaling.set_defaults(command=_scaling)
    for parser in (attacks, fuzz, fleet, soak, scaling):
        parser.add_argument("--json", metavar="OUT", help="write what was seen; - for stdout")


def _out(args: argparse.Namespace) -> TextIO:
    """Where words go, so that stdout is JSON alone where that was asked for."""
    return sys.stderr if args.json == "-" else sys.stdout


def _end(args: argparse.Namespace, result: Any, failures: Sequence[str]) -> int:
    """Write the JSON. Raises RunFailed where something is not as claimed."""
    from velod.cli.files import write_json

    if args.json is not None:
        write_json(args.json, result)
    if failures:
        raise RunFailed("; ".join(failures))
    return 0


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _attacks(args: argparse.Namespace) -> int:
    """Raises RunFailed where an attempt passed or something died."""
    from velod.prove.attacks import besiege
    from velod.prove.besieged import SiegeError
    from velod.sim import simulated_recording

    try:
        siege = besiege(simulated_recording("corridor-1", 5.0, seed=1), speed=0.5)
    except SiegeError as e:
        raise RunFailed(str(e)) from None
    out = _out(args)
    print("| attempt | by | what happened |\n|---|---|---|", file=out)
    for o in siege.outcomes:
        print(f"| {o.attempt} | {o.holder} | {o.happened}{'' if o.repelled else ' **PASSED**'} |", file=out)
    growth = ", ".join(f"{worker} {mib:+.0f}" for worker, mib in sorted(siege.growth_mib.items()))
    print(
        f"\nvelocities at the consumer meanwhile: {siege.served}, at the most {siege.longest_gap_s:.2f} s apart;"
        f" died: {', '.join(siege.died) or 'nobody'}; memory, MiB: {growth}",
        file=out,
    )
    return _end(args, asdict(siege), siege.failures())


def _fuzz(args: argparse.Namespace) -> int:
    """Raises RunFailed where a decoder raised what it must not, or took memory without limit."""
    from velod.prove.fuzz import SHARES, FuzzError, fuzz

    results = []
    out = _out(args)
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
    return _end(args, [asdict(r) for r in results], [f"{r.decoder}: {r.crash}" for r in results if r.crash])


def _fleet(args: argparse.Namespace) -> int:
    """Raises RunFailed where more than a hundredth of the velocities did not come."""
    from velod.prove.fleet import FleetError, run_fleet

    try:
        fleet = run_fleet(args.rigs, args.hz, args.seconds, tls=args.tls)
    except FleetError as e:
        raise RunFailed(str(e)) from None
    print(
        f"{fleet.rigs} rigs at {fleet.hz:g} Hz: {fleet.rate_hz:.0f} velocities per second at the consumer"
        f" ({100 * fleet.share:.1f} %), {fleet.lost} lost, {fleet.overflowed} of them in the consumer's"
        f" queues, {fleet.silent} rigs not heard; latency p50"
        f" {fleet.latency_p50_ms:.2f} ms, p99 {fleet.latency_p99_ms:.2f} ms; cores: router {fleet.router_cores:.2f},"
        f" consumer {fleet.consumer_cores:.2f}, all rigs {fleet.rigs_cores:.2f}; router {fleet.router_mib:.0f} MiB",
        file=_out(args),
    )
    failures = [] if fleet.share >= 0.99 else [f"{100 * fleet.share:.1f} % of the velocities came"]
    return _end(args, asdict(fleet), failures)


def _soak(args: argparse.Namespace) -> int:
    """Raises RunFailed where memory, files or latency grow."""
    from velod.prove.besieged import SiegeError
    from velod.prove.soak import soak
    from velod.sim import simulated_recording

    try:
        recording = simulated_recording("corridor-1", 5.0, seed=1)
        result = soak(recording, args.seconds, args.fault_every, args.seed, _say)
    except SiegeError as e:
        raise RunFailed(str(e)) from None
    out = _out(args)
    hits = ", ".join(f"{fault} {n} times" for fault, n in sorted(result.faults.items()))
    print(
        f"{result.seconds:.0f} s; faults: {hits or 'none'}; {result.served} valid velocities;"
        f" the longest time without one: {result.gap()}; latency {result.latency_middle_ms:.1f} ms in the middle,"
        f" {result.latency_last_ms:.1f} ms in the end; shared memory of all {result.shared_mib:.0f} MiB"
        f" ({result.shared_growth_mib:+.1f} MiB since the beginning); load of the machine up to"
        f" {result.highest_load:.1f} on {os.cpu_count()} cores",
        file=out,
    )
    for p in result.processes:
        kept = "nothing can be said" if p.death_mib is None else f"{p.death_mib:+.2f} MiB, {p.death_files:+.1f} files"
        print(
            f"{p.worker:<14} {p.seconds:6.0f} s  {p.mib:6.1f} MiB, {p.files} files; in the last third"
            f" {p.growth_mib:+.2f} MiB ({p.slope_mib_h:+.2f} MiB/h), {p.new_files:+d} files;"
            f" kept of each death {kept}",
            file=out,
        )
    return _end(args, asdict(result), result.failures())


def _scaling(args: argparse.Namespace) -> int:
    """Raises RunFailed where the processes do not come up."""
    from velod.prove.scaling import ScalingError, scaling
    from velod.sim import simulated_recording

    try:
        recording = simulated_recording("corridor-1", args.seconds, seed=1)
        rows = scaling(recording, list(range(1, args.workers + 1)), args.load_ms, args.speed, _say)
    except ScalingError as e:
        raise RunFailed(str(e)) from None
    out = _out(args)
    stages = list(rows[0].costs)
    print(
        "| flow workers | batches closed /s | flow /s | dropped | shed | p50, ms | p99, ms | "
        + " | ".join(f"{stage}: cores, MB/s" for stage in stages)
        + " |\n"
        + "|---" * (7 + len(stages))
        + "|",
        file=out,
    )
    for r in rows:
        costs = " | ".join(f"{r.costs[stage].cores:.2f}, {r.costs[stage].mb_s:.1f}" for stage in stages)
        print(
            f"| {r.workers} | {r.closed_hz:.1f} | {r.flow_hz:.1f} | {r.dropped} | {r.shed} |"
            f" {r.latency_p50_ms:.1f} | {r.latency_p99_ms:.1f} | {costs} |",
            file=out,
        )
    return _end(args, [asdict(row) for row in rows], [])
