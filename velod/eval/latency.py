"""Where the time goes between the end of a batch and its velocity: by the stamps that messages carry, on one host.

A velocity is made of batches, of the IMU, and of word that no other batch ended before it. Outputs lie on a grid of
sensor time, so a batch also waits for the sensor to come to the next output; ``complete`` begins after that.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from velod.optimizer.parts import batch_seq
from velod.types import F64, I64, DepthBatch, FlowBatch, ImuSamples, Message, Velocity
from velod.wire import Envelope

Key = tuple[int, int]
"""Number and end of a batch."""

LEGS = ("closed_to_flow", "closed_to_depth", "complete_to_velocity", "closed_to_velocity")


@dataclass(slots=True)
class Trace:
    """``note`` every FlowBatch, DepthBatch, ImuSamples and Velocity of a service, in any order."""

    _parts: dict[type[Message], dict[Key, int]] = field(default_factory=lambda: {FlowBatch: {}, DepthBatch: {}})
    _closed: dict[Key, int] = field(default_factory=dict)
    _words: list[tuple[int, int, int]] = field(default_factory=list)  # of the IMU, of the events, published at
    _velocities: list[tuple[Key, int, int]] = field(default_factory=list)  # newest batch, t_ns, published at

    def note(self, envelope: Envelope) -> None:
        """One message with its host times."""
        message, t_pub_ns = envelope.message, envelope.t_pub_ns
        if isinstance(message, FlowBatch | DepthBatch):
            key = (batch_seq(message), message.t_ns)
            self._parts[type(message)][key] = t_pub_ns
            self._closed[key] = envelope.t_origin_ns
        elif isinstance(message, ImuSamples):
            self._words.append((message.t_ns, message.event_t_ns, t_pub_ns))
        elif isinstance(message, Velocity):
            self._velocities.append(((message.batch_seq, message.batch_t_ns), message.t_ns, t_pub_ns))

    def legs(self) -> dict[str, F64]:
        """ns of each of LEGS, of every batch that was the newest of a velocity, of its first one."""
        words = np.array(sorted(self._words, key=lambda word: word[2]), np.int64).reshape(-1, 3)
        known_ns = np.maximum.accumulate(words[:, :2], axis=0).min(axis=1) if len(words) else words[:, 0]
        flows, depths = self._parts[FlowBatch], self._parts[DepthBatch]
        rows, seen = [], {(-1, 0)}
        for key, t_ns, t_pub_ns in sorted(self._velocities, key=lambda velocity: velocity[1]):
            if key in seen or key not in flows or key not in depths:
                continue
            seen.add(key)
            if (complete_ns := _complete(known_ns, words[:, 2], t_ns)) is None:
                continue
            closed_ns = self._closed[key]
            since_ns = max(complete_ns, closed_ns)
            rows.append((flows[key] - closed_ns, depths[key] - closed_ns, t_pub_ns - since_ns, t_pub_ns - closed_ns))
        columns = np.array(rows, np.float64).reshape(-1, len(LEGS)).T
        return dict(zip(LEGS, columns, strict=True))


def _complete(known_ns: I64, t_pub_ns: I64, t_ns: int) -> int | None:
    """When IMU and events were known up to ``t_ns``; ``known_ns`` (n,) at ``t_pub_ns`` (n,), both increasing."""
    k = int(np.searchsorted(known_ns, t_ns))
    return int(t_pub_ns[k]) if k < len(known_ns) else None
