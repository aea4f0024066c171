"""Flow and depth of one batch, joined: depth comes at once, flow may come in parts (``ingest.mode = "event"``)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from velod.types import DepthBatch, EventBatch, FlowBatch

_MAX_AGE_NS = 2**32 - 1
_COLUMNS = ("x", "y", "n", "speed", "sigma")


def batch_seq(part: EventBatch | FlowBatch | DepthBatch) -> int:
    """The number that events, flow and depth of one batch have in common."""
    return part.seq if isinstance(part, DepthBatch) or part.batch_seq < 0 else part.batch_seq


@dataclass(slots=True)
class Parts:
    """What has arrived of one batch."""

    depth: DepthBatch | None = None
    flows: dict[int, FlowBatch] = field(default_factory=dict)  # by the position of the first event

    def add(self, part: FlowBatch | DepthBatch) -> bool:
        """Take a part. False where it and those before it are not of one batch: the newer stay.

        They are not when ingest was restarted, since it then counts from 0 again.
        """
        before = self.depth or next(iter(self.flows.values()), None)
        fits = before is None or _of_one_batch(before, part)
        if not fits:
            assert before is not None
            if before.t_ns > part.t_ns:
                return False
            self.depth = None
            self.flows.clear()
        if isinstance(part, FlowBatch):
            self.flows[part.first] = part
        else:
            self.depth = part
        return fits

    @property
    def whole(self) -> DepthBatch | None:
        """The depth, once it and the flow of all its events are there."""
        if self.depth is None or not self.flows:
            return None
        missing = self.depth.n_selected - sum(part.n_selected for part in self.flows.values())
        return None if missing > 0 else self.depth

    def joined(self, depth: DepthBatch) -> FlowBatch:
        """The flow of all events of ``depth`` as one FlowBatch that ends when it does."""
        parts = [self.flows[first] for first in sorted(self.flows)]
        if len(parts) == 1 and parts[0].t_ns == depth.t_ns:
            return parts[0]
        # An age that would not fit is that of an event to which the surfaces of depth no longer reach back.
        ages = [np.minimum(p.age.astype(np.int64) + (depth.t_ns - p.t_ns), _MAX_AGE_NS) for p in parts]
        x, y, n, speed, sigma = (np.concatenate([getattr(p, name) for p in parts]) for name in _COLUMNS)
        index, age = np.concatenate([p.index + np.uint16(p.first) for p in parts]), np.concatenate(ages)
        counts = [p.n_events for p in parts]
        n_events = sum(counts) if min(counts) >= 0 else -1
        return FlowBatch(
            depth.seq, depth.t_ns, depth.n_selected, index, age.astype(np.uint32), x, y, n, speed, sigma,
            depth.seq, 0, depth.t_start_ns, n_events,
        )  # fmt: skip


def _of_one_batch(a: FlowBatch | DepthBatch, b: FlowBatch | DepthBatch) -> bool:
    """Whether two parts of one number belong together; those of an older velod do not say when their batch began."""
    return a.t_ns == b.t_ns if -1 in (a.t_start_ns, b.t_start_ns) else a.t_start_ns == b.t_start_ns
