"""What the front end gave for one recording, kept so that the optimizer can be run on it again and again.

Events do not depend on the IMU's noise: one pass of ingest, flow and depth serves every IMU seed and every variant of
flow, depth and optimizer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from velod.config import Settings
from velod.flow.stage import FlowStage
from velod.geometry.calibration import Calibration
from velod.io.model import Imu
from velod.optimizer.flow_equation import pairs
from velod.optimizer.parts import Parts, batch_seq
from velod.optimizer.stage import OptimizerStage
from velod.types import I64, PATCH, DepthBatch, EventBatch, FlowBatch, ImuSamples, Message, Velocity

_NO_PATCH = np.empty((0, PATCH * PATCH), np.uint32)


@dataclass(frozen=True, slots=True)
class FrontEnd:
    """The messages to the optimizer in the order in which they came, and the events that they speak of."""

    messages: list[FlowBatch | DepthBatch | ImuSamples] = field(default_factory=list)
    selected: list[EventBatch] = field(default_factory=list)  # without their patches

    def note(self, message: Message) -> None:
        """Keep a message; for ``run_offline(on_message=...)``."""
        if isinstance(message, FlowBatch | DepthBatch | ImuSamples):
            self.messages.append(message)
        elif isinstance(message, EventBatch):
            self.selected.append(replace(message, patch=_NO_PATCH))

    @property
    def flows(self) -> list[FlowBatch]:
        """In the order in which they came."""
        return [m for m in self.messages if isinstance(m, FlowBatch)]

    @property
    def depths(self) -> list[DepthBatch]:
        """In the order in which they came."""
        return [m for m in self.messages if isinstance(m, DepthBatch)]

    def batches(self) -> Iterator[tuple[FlowBatch, DepthBatch]]:
        """Flow and depth of each batch, cut down to the events that have both."""
        for flow, depth in pair_up(self.flows, self.depths):
            yield joined(flow, depth)

    def with_imu(self, imu: Imu) -> FrontEnd:
        """The same front end beside another IMU, sampled at the same times.

        Raises ValueError where a sample has no counterpart.
        """
        messages = [_with_samples(m, imu) if isinstance(m, ImuSamples) else m for m in self.messages]
        return replace(self, messages=messages)

    def with_batches(self, change: Callable[[FlowBatch, DepthBatch], tuple[FlowBatch, DepthBatch]]) -> FrontEnd:
        """The same front end with every pair of joined batches changed; those without a partner stay out."""
        changed = {flow.seq: change(flow, depth) for flow, depth in self.batches()}
        messages: list[FlowBatch | DepthBatch | ImuSamples] = []
        for m in self.messages:
            if isinstance(m, ImuSamples):
                messages.append(m)
            elif m.seq in changed and isinstance(m, DepthBatch):
                messages += changed[m.seq]
        return replace(self, messages=messages)


class SecondFlow:
    """Another flow worker that is shown the same selected events; for ``run_offline(on_message=...)``."""

    def __init__(self, settings: Settings, calibration: Calibration) -> None:
        self._stage = FlowStage(settings, calibration)
        self._flows: dict[int, FlowBatch] = {}

    def note(self, message: Message) -> None:
        """Work on an EventBatch; other messages are none of its business."""
        if isinstance(message, EventBatch):
            self._flows.update({flow.seq: flow for flow in self._stage.handle(message)})

    def in_place_of(self, front_end: FrontEnd) -> FrontEnd:
        """``front_end`` with these flows instead of its own."""
        messages = [self._flows[m.seq] if isinstance(m, FlowBatch) else m for m in front_end.messages]
        return replace(front_end, messages=messages)


def estimate(front_end: FrontEnd, settings: Settings, calibration: Calibration) -> list[Velocity]:
    """What the optimizer makes of it."""
    optimizer = OptimizerStage(settings, calibration)
    out = (o for message in front_end.messages for o in optimizer.handle(message))
    return [o for o in out if isinstance(o, Velocity)]


def pair_up(flows: Sequence[FlowBatch], depths: Sequence[DepthBatch]) -> Iterator[tuple[FlowBatch, DepthBatch]]:
    """Flow and depth of each batch that has all its parts, in the order of ``depths``."""
    batches = {depth.seq: Parts(depth) for depth in depths}
    for flow in flows:
        if (parts := batches.get(batch_seq(flow))) is not None:
            parts.add(flow)
    for parts in batches.values():
        if (depth := parts.whole) is not None:
            yield parts.joined(depth), depth


def joined(flow: FlowBatch, depth: DepthBatch) -> tuple[FlowBatch, DepthBatch]:
    """The events that both batches speak of."""
    return taken(flow, depth, *pairs(flow.index, depth.index))


def taken(
    flow: FlowBatch, depth: DepthBatch, at_flow: NDArray[np.integer], at_depth: NDArray[np.integer]
) -> tuple[FlowBatch, DepthBatch]:
    """These rows of both."""
    flow_columns = {name: getattr(flow, name)[at_flow] for name in ("index", "age", "x", "y", "n", "speed", "sigma")}
    depth_columns = {
        name: getattr(depth, name)[at_depth] for name in ("index", "disparity", "inv_depth", "sigma", "refined")
    }
    return replace(flow, **flow_columns), replace(depth, **depth_columns)


def event_times(flow: FlowBatch) -> I64:
    """Sensor time of each flow, (m,) ns."""
    return flow.t_ns - flow.age.astype(np.int64)


def _with_samples(message: ImuSamples, imu: Imu) -> ImuSamples:
    at = np.searchsorted(imu.t_ns, message.sample_t_ns)
    if len(at) and (at[-1] >= len(imu.t_ns) or not np.array_equal(imu.t_ns[at], message.sample_t_ns)):
        raise ValueError("the other IMU was sampled at other times")
    return replace(message, accel=imu.accel[at], gyro=imu.gyro[at])
