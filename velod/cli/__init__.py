"""The command line: what people type. Each command loads what it needs, and only when it runs."""

from velod.cli.entry import main

__all__ = ["main"]
