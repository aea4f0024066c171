"""One recording under every method: the front ends over its events, and what is made of them for each IMU."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from velod.cli.stages import stages_of, true_depth_of
from velod.config import Settings
from velod.eval.baselines import benosman_settings, paper_settings
from velod.eval.compare import Case, compare, without_velocities
from velod.eval.front_end import FrontEnd, SecondFlow, estimate
from velod.eval.imu_alone import ImuAlone, imu_alone
from velod.eval.report import Section, StageTimes, draw_section
from velod.eval.table import Row
from velod.io import Imu, Recording, open_recording
from velod.types import DepthBatch, EventBatch, EventPacket, FlowBatch, ImuPacket, Message, StereoBatch

Tell = Callable[[str, float], None]
"""Called with what is being done and the share of that; NaN where it has none."""

_IMU_STEPS_S = (10.0, 20.0, 30.0, 60.0, 90.0)


@dataclass(frozen=True, slots=True)
class SequenceJob:
    """A simulated sequence to be judged; all that decides about the outcome but the code."""

    name: str
    settings: Settings
    seconds: float
    event_seed: int
    texture_seed: int | None
    imu_seeds: tuple[int, ...]
    imu_seconds: float  # of the IMU alone
    imu_noises: int  # of the IMU alone
    draw: bool  # pictures for a report

    def run(self, tell: Tell) -> Outcome:
        """Simulate, unless that has been done, and judge."""
        from velod.sim import sequence, simulated_recording
        from velod.sim.imu import sample_imu
        from velod.sim.run import true_motion

        recipe = sequence(self.name, self.texture_seed)

        def imus(seconds: float, seeds: Sequence[int]) -> list[Imu]:
            return [sample_imu(recipe.trajectory, recipe.imu, seconds, np.random.default_rng((k, 0))) for k in seeds]

        path = simulated_recording(
            self.name, self.seconds, self.event_seed, lambda share: tell("simulating", share), self.texture_seed
        )
        tell(f"IMU alone over {self.imu_seconds:g} s", np.nan)
        steps_s = tuple(s for s in _IMU_STEPS_S if s <= self.imu_seconds) or (self.imu_seconds,)
        truth = true_motion(recipe.trajectory, steps_s[-1])
        alone = imu_alone(imus(steps_s[-1], range(1, self.imu_noises + 1)), truth, self.settings, steps_s)
        recording = open_recording(path)
        return judge_recording(
            self.name, self.settings, recording, imus(self.seconds, self.imu_seeds), tell, alone=alone, draw=self.draw
        )


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a recording adds to the tables, and to the report if there is one."""

    row: Row
    section: Section | None


def judge_recording(
    name: str,
    settings: Settings,
    recording: Recording,
    imus: Sequence[Imu],
    tell: Tell,
    *,
    alone: ImuAlone | None = None,
    draw: bool,
) -> Outcome:
    """Judge a recording that holds the truth, with each of ``imus``."""
    case, times = _run(settings, recording, name, imus, tell)
    judgement = compare(case, settings, lambda what: tell(what, np.nan))
    tell("flow and depth against the truth", np.nan)
    stages = None if case.true_depth is None else stages_of(settings, recording, case.own, case.true_depth)
    row = Row(name, recording.duration_s, judgement, alone, stages)
    section = draw_section(row, case, recording.left, times) if draw else None
    return Outcome(replace(row, judgement=without_velocities(judgement)), section)


def _run(
    settings: Settings, recording: Recording, name: str, imus: Sequence[Imu], tell: Tell
) -> tuple[Case, StageTimes]:
    """Both front ends, velod's and the paper-like one, over a recording."""
    from velod.runtime.offline import run_front_end
    from velod.runtime.warmup import fill_cache

    assert recording.truth is not None, "the callers have looked"
    calibration, paper = recording.calibration, paper_settings(settings)
    fill_cache(settings, calibration)
    own, like_paper, clock = FrontEnd(), FrontEnd(), _Clock()
    benosman = SecondFlow(benosman_settings(settings), calibration)

    def note(message: Message) -> None:
        clock.stop(message)
        own.note(message)
        benosman.note(message)
        clock.start(message)

    run_front_end(settings, calibration, _telling(recording, "velod's front end", tell), note)
    begin_s = time.perf_counter()
    estimate(own, settings, calibration)
    times = clock.per_batch(len(own.selected), time.perf_counter() - begin_s)
    run_front_end(paper, calibration, _telling(recording, "paper-like front end", tell), like_paper.note)
    case = Case(
        name, calibration, recording.truth, recording.t_start_ns, imus,
        own, benosman.in_place_of(own), like_paper, true_depth_of(recording),
    )  # fmt: skip
    return case, times


def _telling(recording: Recording, what: str, tell: Tell) -> Iterator[EventPacket | ImuPacket]:
    """The packets of a recording, while it is told how far they are."""
    length_ns = max(1, recording.t_end_ns - recording.t_start_ns)
    for packet in recording.packets():
        yield packet
        tell(what, (packet.t_ns - recording.t_start_ns) / length_ns)


@dataclass(slots=True)
class _Clock:
    """Host time that flow and depth take, from the moments at which messages are reported."""

    flow_s: float = 0.0
    depth_s: float = 0.0
    _last_s: float = field(default_factory=time.perf_counter)
    _last: Message | None = None
    _noted_s: float = 0.0  # spent on taking notes
    _begin_s: float = field(default_factory=time.perf_counter)

    def stop(self, message: Message) -> None:
        """A message has come."""
        now = time.perf_counter()
        if isinstance(self._last, EventBatch) and isinstance(message, FlowBatch):
            self.flow_s += now - self._last_s
        elif isinstance(self._last, StereoBatch) and isinstance(message, DepthBatch):
            self.depth_s += now - self._last_s
        self._last_s = now

    def start(self, message: Message) -> None:
        """The message has been noted, and goes on its way."""
        now = time.perf_counter()
        self._noted_s += now - self._last_s
        self._last, self._last_s = message, now

    def per_batch(self, batches: int, back_end_s: float) -> StageTimes:
        """All that is neither flow nor depth is preprocessing, reading the file included."""
        rest_s = self._last_s - self._begin_s - self._noted_s - self.flow_s - self.depth_s
        per_ms = 1e3 / max(1, batches)
        return StageTimes(rest_s * per_ms, self.flow_s * per_ms, self.depth_s * per_ms, back_end_s * per_ms)
