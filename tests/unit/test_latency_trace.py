"""Where a batch's time went, by the stamps of messages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from velod.eval.latency import LEGS, Trace
from velod.optimizer.stage import nothing
from velod.types import ImuSamples, Message, Velocity
from velod.wire import Envelope

MS = 1_000_000
CLOSED_MS = 1000.0


def samples(imu_ms: int, events_ms: int) -> ImuSamples:
    none, no_rows = np.empty(0, np.int64), np.empty((0, 3))
    return ImuSamples(0, imu_ms * MS, events_ms * MS, 0, 8 * MS, none, no_rows, no_rows)


def velocity(t_ms: int, seq: int = 0) -> Velocity:
    return Velocity(t_ms, t_ms * MS, np.zeros(3), np.eye(3), True, "tracking", "", seq, 8 * MS)


def trace(*published: tuple[float, Message]) -> dict[str, list[float]]:
    """Legs in ms of messages that were published so many ms after the batch that ended at 8 ms was closed."""
    out = Trace()
    for after_ms, message in published:
        out.note(Envelope(message, int((CLOSED_MS + after_ms) * MS), int(CLOSED_MS * MS)))
    return {name: (ns / MS).tolist() for name, ns in out.legs().items()}


FLOW, DEPTH = (replace(part, seq=0, t_ns=8 * MS) for part in nothing(0))


def test_legs_are_counted_from_the_batch_and_from_when_all_was_there() -> None:
    """The velocity at 10 ms has to wait for the IMU, which comes to 10 ms later than the events do."""
    legs = trace(
        (0.0, samples(5, 8)),
        (1.0, FLOW),
        (3.0, DEPTH),
        (4.0, samples(5, 10)),
        (5.0, samples(10, 10)),
        (6.5, velocity(10)),
        (9.0, velocity(20)),  # the same batch again
    )
    assert legs == dict(zip(LEGS, ([1.0], [3.0], [1.5], [6.5]), strict=True))


def test_the_wait_for_what_came_before_the_batch_is_none() -> None:
    legs = trace((-2.0, samples(10, 10)), (1.0, FLOW), (3.0, DEPTH), (4.0, velocity(10)))
    assert legs["complete_to_velocity"] == legs["closed_to_velocity"] == [4.0]


def test_a_velocity_without_a_batch_or_with_half_of_one_is_left_out() -> None:
    half = trace((0.0, samples(10, 10)), (1.0, FLOW), (4.0, velocity(10)), (5.0, velocity(20, seq=-1)))
    assert half == {name: [] for name in LEGS}
