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
    for parser in (attacks, fuzz):
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
