"""The network's side of dispatch: ingest's batches to the workers that are alive, one key per worker."""

from __future__ import annotations

import time

from velod.runtime.dispatch import Assignment, Dispatcher
from velod.runtime.outlet import Outlet
from velod.runtime.prime import LARGE
from velod.types import Done, EventBatch, StereoBatch
from velod.wire import encode
from velod.wire.topics import BATCH_DEPTH, BATCH_FLOW, PRIME, Topic

WINDOW = 2
"""Batches a worker is sent before it has finished the first: one in work, one on its way."""
QUEUE = 64
"""Batches that wait while no worker is free; at 50 a second more than a second's worth."""
TIMEOUT_S = 2.0
"""A worker that has not finished a batch by then has lost it, or hangs."""
IMPATIENCE_S = 0.05
"""Where another worker could take over: the optimizer waits for 60 ms."""
MAX_WAIT_S = 0.5
"""A batch that has waited for longer is not sent any more: half the optimizer's window is over."""

LOOK_S = 0.005
"""Between looks for batches that have been outstanding for too long."""

SENT = "sent."
"""Begins the names of the counters of batches sent to each worker."""

_TOPIC: dict[str, Topic] = {"flow": BATCH_FLOW, "depth": BATCH_DEPTH}


class BatchDispatch:
    """Dispatchers for flow and depth, fed by liveliness tokens and Done messages."""

    def __init__(self, outlet: Outlet, lossless: bool) -> None:
        self._outlet = outlet
        self._dispatchers: dict[str, Dispatcher[bytes]] = {
            stage: Dispatcher(WINDOW, None)
            if lossless
            else Dispatcher(WINDOW, QUEUE, TIMEOUT_S, MAX_WAIT_S, IMPATIENCE_S)
            for stage in _TOPIC
        }
        self._sent: dict[str, int] = {}  # batches, by worker
        self._look_s = 0.0

    def send(self, batch: EventBatch | StereoBatch, t_origin_ns: int) -> None:
        """Give a batch to a worker now, or as soon as one is free."""
        stage = "flow" if isinstance(batch, EventBatch) else "depth"
        data = encode(batch, time.time_ns(), t_origin_ns)
        self._put(stage, self._dispatchers[stage].submit(batch.seq, data, time.monotonic()))

    def done(self, done: Done) -> None:
        """A worker reports that it has finished a batch."""
        if done.stage in self._dispatchers:
            self._put(done.stage, self._dispatchers[done.stage].done(done.worker, done.seq, time.monotonic()))

    def alive(self, token: dict[str, str], *, is_there: bool) -> None:
        """A liveliness token, by its key's parts, came or went."""
        dispatcher = self._dispatchers.get(token["stage"])
        if dispatcher is not None:
            if is_there:
                self._outlet.publish_bytes(PRIME, bytes(LARGE))  # or its first batch is slow
            change = dispatcher.join if is_there else dispatcher.leave
            self._put(token["stage"], change(token["worker"], time.monotonic()))

    def expire(self) -> None:
        """Take back what has been outstanding for too long; call often."""
        if (now_s := time.monotonic()) < self._look_s:
            return
        self._look_s = now_s + LOOK_S
        for stage, dispatcher in self._dispatchers.items():
            self._put(stage, dispatcher.expire(now_s))

    def load(self, *stages: str) -> tuple[float, int]:
        """Of the busiest of ``stages``: how long a new batch's predecessors have been there, s, and how many wait."""
        now_s, dispatchers = time.monotonic(), [self._dispatchers[stage] for stage in stages]
        return max(d.delay_s(now_s) for d in dispatchers), max(len(d.waiting) for d in dispatchers)

    def unanswered_s(self) -> float:
        """How long the oldest batch, of either stage, has been there that no worker has finished."""
        now_s = time.monotonic()
        return max(dispatcher.unanswered_s(now_s) for dispatcher in self._dispatchers.values())

    def counters(self) -> dict[str, int]:
        """Counters of both dispatchers, ``dispatch.overflow.flow`` and so on, and of each worker, ``sent.flow-0``."""
        counted = {f"{SENT}{worker}": n for worker, n in self._sent.items()}
        for stage, dispatcher in self._dispatchers.items():
            counted |= {f"{name}.{stage}": n for name, n in dispatcher.counters.items()}
        return counted

    def alarms(self) -> dict[str, str]:
        """Stages without a worker."""
        return {f"workers.{stage}": f"no {stage} worker" for stage, d in self._dispatchers.items() if not d.workers}

    def _put(self, stage: str, assignments: list[Assignment[bytes]]) -> None:
        for a in assignments:
            self._outlet.publish_bytes(_TOPIC[stage], a.batch, worker=a.worker)
            self._sent[a.worker] = self._sent.get(a.worker, 0) + 1
