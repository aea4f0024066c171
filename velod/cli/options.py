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
