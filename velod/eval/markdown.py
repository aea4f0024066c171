"""Tables written into a Markdown file, in place of those that an earlier run wrote there."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from velod.eval.table import text_table


class MarkdownError(ValueError):
    """A file that has no place for the tables; the text says which it looked for."""


def put_into(
    path: str | Path, command: str, commit: str, tables: Mapping[str, Sequence[Sequence[str]]], notes: Sequence[str]
) -> None:
    """Replace what stands between ``<!-- COMMAND -->`` and ``<!-- end -->`` by that command's tables and notes.

    Raises MarkdownError where the file has no such place, OSError where it cannot be read or written.
    """
    text, begin = Path(path).read_text(encoding="utf-8"), f"<!-- {command} -->"
    place = require_place(path, command)
    blocks = "\n\n".join(f"{title}\n{text_table(lines)}" for title, lines in tables.items())
    said = "\n".join(notes)
    block = f"{begin}\n`{command}` at `{commit}`:\n\n```\n{blocks}\n\n{said}\n```\n<!-- end -->"
    Path(path).write_text(place.sub(lambda _: block, text), encoding="utf-8")


def require_place(path: str | Path, command: str) -> re.Pattern[str]:
    """What matches the place of a command's tables. Raises MarkdownError, OSError as ``put_into`` does."""
    begin = f"<!-- {command} -->"
    place = re.compile(re.escape(begin) + r".*?<!-- end -->", re.DOTALL)
    if not place.search(Path(path).read_text(encoding="utf-8")):
        raise MarkdownError(f"{path}: there is no place for these tables: {begin} ... <!-- end -->")
    return place
