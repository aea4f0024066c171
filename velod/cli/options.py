"""What the parsers of several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TypeAlias

from velod.cli.network import add_way_options

# argparse has no public name for it, and does not let it be subscripted when it runs.
Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def plain(factory: Callable[..., argparse.ArgumentParser], *args: str, **kwargs: str) -> argparse.ArgumentParser:
    """A parser that keeps the line breaks of its texts."""
    return factory(*args, formatter_class=argparse.RawDescriptionHelpFormatter, **kwargs)


def command(
    commands: Commands,
    name: str,
    function: Callable[[argparse.Namespace], int],
    summary: str,
    text: str,
    examples: str,
) -> argparse.ArgumentParser:
    """The parser of a command that ``function`` runs; a line for the list of all, a text and worked examples."""
    parser = plain(
        commands.add_parser, name, help=summary, description=f"{summary}\n\n{text}", epilog=f"examples:\n{examples}"
    )
    parser.set_defaults(command=function)
    return parser


def add_config_option(parser: argparse.ArgumentParser) -> None:
    """Which settings."""
    parser.add_argument("-c", "--config", metavar="FILE", help="settings (TOML); `velod config init` writes one")


def add_watch_options(parser: argparse.ArgumentParser) -> None:
    """Which velod to look at."""
    add_config_option(parser)
    add_way_options(parser)


def speed(text: str) -> float:
    """Times real time; infinity for ``max``."""
    if text == "max":
        return float("inf")
    return seconds(text)


def seconds(text: str) -> float:
    """A time span, or any other number that is positive and finite."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"not a number: {text!r}") from None
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be positive and finite, got {text}")
    return value


def count(text: str) -> int:
    """A whole number from 1 on."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 on, got {text!r}")
    return int(text)
