"""The command line: what people type. Each command loads what it needs, and only when it runs."""

import sys
from collections.abc import Sequence

EXIT_INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the exit code. What a user can put right is one line on stderr, never a traceback."""
    try:
        # Not before: Ctrl-C may come while modules are loaded.
        from velod.cli.entry import run

        return run(argv)
    except KeyboardInterrupt:
        print("velod: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


__all__ = ["EXIT_INTERRUPTED", "main"]
