"""Between the network's threads and the worker's main thread: bounded queues, in the order of arrival."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, field


@dataclass(slots=True)
class Item:
    """Something that arrived: which source, from which key, what, and when (host clock, ns)."""

    source: str
    key: str
    data: bytes
    t_ns: int


@dataclass(slots=True)
class _Source:
    capacity: int
    urgent: bool
    items: deque[Item] = field(default_factory=deque)


class Inbox:
    """One queue per source, each bounded: when one is full its oldest item makes room, and that is counted.

    ``put`` never blocks, so a slow worker holds up no thread of the network. ``get`` serves urgent sources first,
    and otherwise all in the order of arrival.
    """

    def __init__(self) -> None:
        self.counters: dict[str, int] = {}
        self._sources: dict[str, _Source] = {}
        self._turns: deque[str] = deque()  # one entry per queued item
        self._urgent_turns: deque[str] = deque()
        self._ready = threading.Condition()

    def add_source(self, name: str, capacity: int, urgent: bool = False) -> None:
        """Accept items of source ``name``, ``capacity`` of them at once; urgent ones overtake all others."""
        with self._ready:
            self._sources[name] = _Source(capacity, urgent)

    def put(self, source: str, key: str, data: bytes) -> None:
        """Add an item; called from any thread."""
        with self._ready:
            queue = self._sources[source]
            if len(queue.items) >= queue.capacity:
                # The turn of the item dropped here serves the one after it.
                queue.items.popleft()
                name = f"inbox.overflow.{source}"
                self.counters[name] = self.counters.get(name, 0) + 1
            else:
                (self._urgent_turns if queue.urgent else self._turns).append(source)
            queue.items.append(Item(source, key, data, time.time_ns()))
            self._ready.notify()

    def get(self, timeout_s: float) -> Item | None:
        """The next item; None after ``timeout_s`` without one."""
        with self._ready:
            if not self._ready.wait_for(lambda: bool(self._urgent_turns or self._turns), timeout_s):
                return None
            turns = self._urgent_turns or self._turns
            return self._sources[turns.popleft()].items.popleft()

    def waiting(self) -> int:
        """Items queued now."""
        with self._ready:
            return len(self._urgent_turns) + len(self._turns)
