"""Context managers made of context managers."""

from __future__ import annotations

from contextlib import ExitStack
from types import TracebackType
from typing import Self


class Stacked:
    """Opens one thing after the other, and closes all in reverse order: at its end, and where opening fails."""

    _stack: ExitStack

    def _open(self, stack: ExitStack) -> None:
        """Enter into ``stack`` whatever is to be closed again."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._open(stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()
