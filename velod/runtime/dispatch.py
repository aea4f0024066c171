"""Which worker gets which batch: the least loaded one, and what a dead worker held goes to another.

Zenoh has no consumer groups, so the producer chooses. No input or output and no clock here: calls in, assignments
out; ``now_s`` is any clock that does not go backwards.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Assignment(Generic[T]):
    """Send ``batch`` to ``worker``."""

    worker: str
    seq: int
    batch: T


@dataclass(frozen=True, slots=True)
class _Waiting(Generic[T]):
    seq: int
    batch: T
    since_s: float


@dataclass(slots=True)
class _Worker(Generic[T]):
    # seq -> (batch, when it was sent), oldest first: what it has not finished.
    outstanding: dict[int, tuple[T, float]] = field(default_factory=dict)
    silent: bool = False  # let a batch expire, and has finished nothing since


class Dispatcher(Generic[T]):
    """Batches go to the worker with the fewest outstanding ones (ties: the lowest name), ``window`` each at the most.

    While every window is full, or nobody is there, batches wait in a queue of ``capacity`` (None: unbounded, for
    lossless replay); when it is full the oldest are dropped and counted as ``dispatch.overflow``. One that waits for
    longer than ``max_wait_s`` is dropped and counted as ``dispatch.stale``. What a worker had not finished when it
    left is sent to others, before newer batches (``dispatch.resent``). A worker that does not finish a batch in
    ``timeout_s`` is treated likewise (``dispatch.expired``), and then is given work only while there is nobody else,
    until it finishes something: its message may have been lost, or it hangs. Where another worker could take over,
    the limit is ``impatience_s``, or ``SLOW`` times as long as batches take if that is longer: a result that comes
    after seconds is of no use.
    """

    SLOW = 8.0
    _SMOOTHING = 0.1  # of how long batches take

    def __init__(
        self,
        window: int = 2,
        capacity: int | None = 64,
        timeout_s: float = math.inf,
        max_wait_s: float = math.inf,
        impatience_s: float = math.inf,
    ) -> None:
        if window < 1 or (capacity is not None and capacity < 1) or not timeout_s > 0.0 or not max_wait_s > 0.0:
            raise ValueError("window and capacity must be at least 1, timeout_s and max_wait_s positive")
        self.counters: dict[str, int] = {}
        self._window = window
        self._capacity = capacity
        self._timeout_s = timeout_s
        self._max_wait_s = max_wait_s
        self._impatience_s = impatience_s
        self._typical_s = 0.0  # from sending a batch to its end
        self._workers: dict[str, _Worker[T]] = {}
        self._queue: deque[_Waiting[T]] = deque()

    def join(self, worker: str, now_s: float) -> list[Assignment[T]]:
        """A worker is there. One that is already known has been started anew: what it held is sent again."""
        if worker in self._workers:
            self._requeue(self._workers[worker], "dispatch.resent", now_s)
        self._workers[worker] = _Worker()
        return self._assign(now_s)

    def leave(self, worker: str, now_s: float) -> list[Assignment[T]]:
        """A worker is gone."""
        gone = self._workers.pop(worker, None)
        if gone is not None:
            self._requeue(gone, "dispatch.resent", now_s)
        return self._assign(now_s)

    def submit(self, seq: int, batch: T, now_s: float) -> list[Assignment[T]]:
        """A new batch; ``seq`` identifies it."""
        self._queue.append(_Waiting(seq, batch, now_s))
        assignments = self._assign(now_s)
        while self._capacity is not None and len(self._queue) > self._capacity:
            self._queue.popleft()
            self._count("dispatch.overflow", 1)
        return assignments

    def done(self, worker: str, seq: int, now_s: float) -> list[Assignment[T]]:
        """A worker has finished a batch; one that was given to another meanwhile changes nothing there."""
        known = self._workers.get(worker)
        if known is not None:
            _, sent_s = known.outstanding.pop(seq, (None, now_s))
            known.silent = False
            self._typical_s += self._SMOOTHING * (now_s - sent_s - self._typical_s)
        return self._assign(now_s)

    def expire(self, now_s: float) -> list[Assignment[T]]:
        """Call now and then: takes back what has been outstanding for too long."""
        for name, worker in self._workers.items():
            limit_s = self._limit_s(name)
            if any(now_s - sent_s > limit_s for _, sent_s in worker.outstanding.values()):
                self._requeue(worker, "dispatch.expired", now_s)
                worker.silent = True
        return self._assign(now_s)

    @property
    def workers(self) -> dict[str, tuple[int, ...]]:
        """Who is there, and the batches each was sent and has not finished."""
        return {name: tuple(w.outstanding) for name, w in self._workers.items()}

    @property
    def waiting(self) -> tuple[int, ...]:
        """The batches that wait for a worker, the next one first."""
        return tuple(waiting.seq for waiting in self._queue)

    def delay_s(self, now_s: float) -> float:
        """How long that has been there for which a new batch has to wait: the queue, or the next worker's own work.

        0 where a worker has nothing to do.
        """
        if self._queue:
            return now_s - self._queue[0].since_s
        if (name := self._choose()) is None:
            return 0.0
        return now_s - min((sent_s for _, sent_s in self._workers[name].outstanding.values()), default=now_s)

    def unanswered_s(self, now_s: float) -> float:
        """How long the oldest batch has been there that no worker has finished; 0 where there is none."""
        oldest_s = self._queue[0].since_s if self._queue else now_s
        for worker in self._workers.values():
            for _, sent_s in worker.outstanding.values():
                oldest_s = min(oldest_s, sent_s)
        return now_s - oldest_s

    def _limit_s(self, worker: str) -> float:
        others = any(name != worker and not w.silent for name, w in self._workers.items())
        return (
            min(self._timeout_s, max(self._impatience_s, self.SLOW * self._typical_s)) if others else self._timeout_s
        )

    def _requeue(self, worker: _Worker[T], why: str, now_s: float) -> None:
        unfinished = reversed(worker.outstanding.items())
        self._queue.extendleft(_Waiting(seq, batch, now_s) for seq, (batch, _) in unfinished)
        self._count(why, len(worker.outstanding))
        worker.outstanding.clear()

    def _assign(self, now_s: float) -> list[Assignment[T]]:
        assignments: list[Assignment[T]] = []
        while self._queue and now_s - self._queue[0].since_s > self._max_wait_s:
            self._queue.popleft()
            self._count("dispatch.stale", 1)
        while self._queue and (name := self._choose()) is not None:
            waiting = self._queue.popleft()
            self._workers[name].outstanding[waiting.seq] = (waiting.batch, now_s)
            assignments.append(Assignment(name, waiting.seq, waiting.batch))
        return assignments

    def _choose(self) -> str | None:
        responsive = {name: w for name, w in self._workers.items() if not w.silent}
        free = [
            (len(w.outstanding), name)
            for name, w in (responsive or self._workers).items()
            if len(w.outstanding) < self._window
        ]
        return min(free)[1] if free else None

    def _count(self, name: str, n: int) -> None:
        if n:
            self.counters[name] = self.counters.get(name, 0) + n
