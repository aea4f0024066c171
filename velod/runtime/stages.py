"""What the runtime knows of a stage: its name, its class, and ``handle``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

from velod.config import Settings
from velod.geometry.calibration import Calibration
from velod.ingest.budget import Budget
from velod.types import Message

STAGES = ("ingest", "flow", "depth", "optimizer")


class Stage(Protocol):
    """A stage does no input or output of its own: messages in, messages out."""

    @property
    def counters(self) -> Mapping[str, int]:
        """What happened since the start, by name."""
        ...

    def handle(self, message: Any, /) -> Sequence[Message]:
        """What follows from one message, in the order in which it is to be published."""
        ...


@runtime_checkable
class Limited(Protocol):
    """A stage that can be told how much to take on."""

    budget: Budget


@runtime_checkable
class Reckoning(Protocol):
    """A stage that integrates the velocity, and can be told to begin anew."""

    def reset_odometry(self) -> None:
        """Begin a new dead reckoning with the next valid velocity."""
        ...


@runtime_checkable
class Inertial(Protocol):
    """A stage that goes on by the IMU alone."""

    @property
    def time_offset_s(self) -> float:
        """Of the IMU's clock: t_imu = t_cam + time_offset_s."""
        ...


@runtime_checkable
class Tidying(Protocol):
    """A stage with work that its outputs need not wait for."""

    def tidy(self) -> None:
        """Do what was put off; ``handle`` begins with it, so nothing is put off for longer than a message."""
        ...


_CLASSES = {
    "ingest": ("velod.ingest.stage", "IngestStage"),
    "flow": ("velod.flow.stage", "FlowStage"),
    "depth": ("velod.depth.stage", "DepthStage"),
    "optimizer": ("velod.optimizer.stage", "OptimizerStage"),
}


def create_stage(name: str, settings: Settings, calibration: Calibration) -> Stage:
    """The stage of this name. Imports it only now, so that a worker loads no other stage's code."""
    if name not in _CLASSES:
        raise ValueError(f"no stage {name!r}; stages: {', '.join(STAGES)}")
    module, class_name = _CLASSES[name]
    stage: Stage = getattr(import_module(module), class_name)(settings, calibration)
    return stage


def import_all() -> None:
    """Import the code of all stages."""
    for module, _ in _CLASSES.values():
        import_module(module)


def alarms_of(stage: Stage) -> dict[str, str]:
    """The alarms of a stage that has any."""
    alarms: dict[str, str] = getattr(stage, "alarms", {})
    return dict(alarms)


def gauges_of(stage: Stage) -> dict[str, float]:
    """What a stage measures that is neither count nor time, by name and unit."""
    gauges: dict[str, float] = getattr(stage, "gauges", {})
    return dict(gauges)


def worker_names(settings: Settings, stage: str) -> list[str]:
    """The workers of one stage: ``flow-0``, ``flow-1``, ..."""
    count = {
        "flow": settings.flow.workers,
        "depth": settings.depth.workers,
        # In a lossless replay nobody may be passed over for being late.
        "optimizer": 1 if settings.zenoh.lossless else settings.optimizer.workers,
    }.get(stage, 1)
    return [f"{stage}-{i}" for i in range(count)]


def stage_of(worker: str) -> str:
    """The stage of a worker's name. Raises ValueError for a name that is not ``<stage>-<number>``."""
    stage, _, number = worker.rpartition("-")
    if stage not in STAGES or not number.isdecimal():
        raise ValueError(f"worker {worker!r}: must be <stage>-<number>, such as flow-0; stages: {', '.join(STAGES)}")
    return stage
