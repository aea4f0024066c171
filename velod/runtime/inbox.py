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
    max_bytes: int | None
    held_bytes: int = 0
    items: deque[Item] = field(default_factory=deque)

    def make_room(self, n_bytes: int) -> int:
        """Drop the oldest items until one of ``n_bytes`` fits; returns how many."""
        dropped = 0
        while self.items and (
            len(self.items) >= self.capacity
            or (self.max_bytes is not None and self.held_bytes + n_bytes > self.max_bytes)
        ):
            self.pop()
            dropped += 1
        return dropped

    def push(self, item: Item) -> None:
        self.items.append(item)
        self.held_bytes += len(item.data)

    def pop(self) -> Item:
        item = self.items.popleft()
        self.held_bytes -= len(item.data)
        return item


class Inbox:
    """One queue per source, each bounded: when one is full its oldest items make room, and that is counted.

    ``put`` never blocks, so a slow worker holds up no thread of the network. ``get`` serves urgent sources first,
    and otherwise all in the order of arrival.
    """

    def __init__(self) -> None:
        self.counters: dict[str, int] = {}
        self._sources: dict[str, _Source] = {}
        self._turns: deque[str] = deque()  # one entry per queued item
        self._urgent_turns: deque[str] = deque()
        self._lock = threading.Lock()
        # Locked while nothing has come since ``get`` last looked: a bare lock wakes its waiter in half the time that
        # a Condition takes.
        self._nothing_new = threading.Lock()
        self._nothing_new.acquire()

    def add_source(self, name: str, capacity: int, urgent: bool = False, max_bytes: int | None = None) -> None:
        """Accept items of source ``name``, ``capacity`` of them at once, and no more of them than ``max_bytes``
        (but one); urgent ones overtake all others.
        """
        with self._lock:
            self._sources[name] = _Source(capacity, urgent, max_bytes)

    def put(self, source: str, key: str, data: bytes) -> None:
        """Add an item; called from any thread."""
        t_ns = time.time_ns()
        with self._lock:
            queue = self._sources[source]
            turns = self._urgent_turns if queue.urgent else self._turns
            if dropped := queue.make_room(len(data)):
                name = f"inbox.overflow.{source}"
                self.counters[name] = self.counters.get(name, 0) + dropped
                # The turn of the last item dropped serves the one after it.
                for _ in range(dropped - 1):
                    turns.remove(source)
            else:
                turns.append(source)
            queue.push(Item(source, key, data, t_ns))
            if self._nothing_new.locked():
                self._nothing_new.release()

    def get(self, timeout_s: float) -> Item | None:
        """The next item; None after ``timeout_s`` without one."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            with self._lock:
                if turns := self._urgent_turns or self._turns:
                    return self._sources[turns.popleft()].pop()
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0 or not self._nothing_new.acquire(timeout=min(left_s, threading.TIMEOUT_MAX)):
                return None

    def waiting(self) -> int:
        """Items queued now."""
        with self._lock:
            return len(self._urgent_turns) + len(self._turns)
