"""One command: from what was typed to the exit code."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from io import TextIOWrapper

from velod import __version__
from velod.cli import play_commands, proof_commands, service_commands, watch_commands
from velod.cli.exit import EXIT_FAILED, EXIT_USAGE, RunFailed, interrupt_on_signals
from velod.cli.options import plain
from velod.cli.values import require_writable
from velod.runtime.kernel_cache import ensure_cache_directory


def run(argv: Sequence[str] | None = None) -> int:
    """Run one command; the exit code. Raises KeyboardInterrupt on Ctrl-C and SIGTERM."""
    _provide_streams()
    try:
        interrupt_on_signals()
        args = parser().parse_args(argv)
        command: Callable[[argparse.Namespace], int] = args.command
        ensure_cache_directory()
        require_writable(*(getattr(args, option, None) for option in ("json", "csv", "markdown")))
        return command(args)
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


def _provide_streams() -> None:
    """Somewhere to write to where stdout or stderr was closed; a ``?`` for what their encoding does not have."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 (as long as the process)
        elif isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


def _one_line(e: Exception) -> str:
    if isinstance(e, OSError) and e.strerror:
        return e.strerror if e.filename is None else f"{e.filename}: {e.strerror}"
    return " ".join(str(e).split()) or type(e).__name__


def parser() -> argparse.ArgumentParser:
    """That of all commands."""
    top = plain(
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
    top.add_argument("--version", action="version", version=f"velod {__version__}")
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for group in (play_commands, service_commands, watch_commands, proof_commands):
        group.add_commands(commands)
    return top
