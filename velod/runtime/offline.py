"""The four stages chained in one process: the same bits as the processes, without them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

from velod.config import Settings
from velod.geometry.calibration import Calibration
from velod.runtime.stages import STAGES, Stage, Tidying, alarms_of, create_stage
from velod.types import EventBatch, EventPacket, ImuPacket, Message, StereoBatch, Velocity


def run_offline(
    settings: Settings,
    calibration: Calibration,
    packets: Iterable[EventPacket | ImuPacket],
    on_message: Callable[[Message], None] | None = None,
    counters: dict[str, dict[str, int]] | None = None,
    alarms: dict[str, str] | None = None,
) -> list[Velocity]:
    """Every velocity that the packets lead to, in order.

    ``on_message`` is called with each message that a stage puts out, before the next stage sees it. ``counters``
    is filled with the counters of each stage by name, ``alarms`` with those that stand at the end.
    """
    stages = {name: create_stage(name, settings, calibration) for name in STAGES}
    velocities: list[Velocity] = []
    for estimate in _front_end(stages, packets, on_message):
        for velocity in stages["optimizer"].handle(estimate):
            _note(velocity, on_message)
            if isinstance(velocity, Velocity):
                velocities.append(velocity)
    for stage in stages.values():
        if isinstance(stage, Tidying):
            stage.tidy()
    if counters is not None:
        counters.update({name: dict(stage.counters) for name, stage in stages.items()})
    if alarms is not None:
        for stage in stages.values():
            alarms.update(alarms_of(stage))
    return velocities


def run_front_end(
    settings: Settings,
    calibration: Calibration,
    packets: Iterable[EventPacket | ImuPacket],
    on_message: Callable[[Message], None],
) -> None:
    """As ``run_offline``, but nothing is made of what flow and depth put out."""
    stages = {name: create_stage(name, settings, calibration) for name in ("ingest", "flow", "depth")}
    for _ in _front_end(stages, packets, on_message):
        pass


def _front_end(
    stages: Mapping[str, Stage],
    packets: Iterable[EventPacket | ImuPacket],
    on_message: Callable[[Message], None] | None,
) -> Iterator[Message]:
    """The messages to the optimizer."""
    # What a message leads to is handled before the message's successor: the order of one ideal network.
    route = {EventBatch: stages["flow"], StereoBatch: stages["depth"]}
    for packet in packets:
        for selected in stages["ingest"].handle(packet):
            _note(selected, on_message)
            worker = route.get(type(selected))
            if worker is None:
                yield selected
                continue
            for estimate in worker.handle(selected):
                _note(estimate, on_message)
                yield estimate


def _note(message: Message, on_message: Callable[[Message], None] | None) -> None:
    if on_message is not None:
        on_message(message)
