"""``velod eval --table``, ``--report`` and ``--floor``: velod beside its baselines and the paper's numbers."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from velod import __version__
from velod.cli_config import calibration_of, settings_of
from velod.cli_exit import RunFailed
from velod.cli_report import Line, progress_bar, write_json
from velod.cli_stages import stages_of, true_depth_of
from velod.config import Settings
from velod.eval.baselines import benosman_settings, integrate_imu, paper_settings
from velod.eval.compare import Case, compare, judge
from velod.eval.floor import with_perfect_flow_and_depth
from velod.eval.front_end import FrontEnd, SecondFlow, estimate
from velod.eval.metrics import evaluate
from velod.eval.report import Report, StageTimes
from velod.eval.stage_errors import StageErrors
from velod.eval.stage_tables import group_tables, overview_tables
from velod.eval.table import Row, as_json, ave_table, detail_table, notes, rve_table, text_table
from velod.io import Imu, Recording, open_recording
from velod.types import DepthBatch, EventBatch, EventPacket, FlowBatch, ImuPacket, Message, StereoBatch

_EVENT_SEED = 1
_SEEDS = (1, 2, 3, 4, 5)
_QUICK_SEEDS = (1,)
_SECONDS = {"corridor": 10.0, "boxes": 10.0, "spin": 3.0}
_QUICK_SECONDS = {"corridor": 1.0, "boxes": 1.0, "spin": 0.6}
# As long as the paper's must have been for its errors of IMU integration (DESIGN 4.14).
_IMU_SECONDS = {"corridor": 90.0, "boxes": 30.0, "spin": 30.0}


def compare_sequences(config: str | None, *, quick: bool, json: str | None, report: str | None) -> int:
    """The synthetic sequences of Table I. Raises RunFailed where one yields no valid velocity."""
    from velod.sim import TABLE_I

    settings = settings_of(config)
    seeds = _QUICK_SEEDS if quick else _SEEDS
    lengths = _QUICK_SECONDS if quick else _SECONDS
    # Within the command's own name: what made the page can be typed again.
    command = "velod eval --table synthetic" + (" --quick" if quick else "")
    page = None if report is None else Report(report, f"{command} (velod {__version__})")
    rows = []
    progress = _Progress(len(TABLE_I))
    for name in TABLE_I:
        seconds = lengths[name.split("-")[0]]
        rows.append(_simulated_row(settings, name, seconds, seeds, progress, page))
        progress.next()
    progress.finish()
    return _finish(rows, seeds, json, page)


def compare_files(
    config: str | None, files: Sequence[str], json: str | None, report: str, calibration: str | None = None
) -> int:
    """Recordings that hold the truth. Raises RunFailed where one yields no valid velocity."""
    settings = settings_of(config, calibration)
    page = Report(report, f"velod eval {' '.join(files)} --report (velod {__version__})")
    rows = []
    progress = _Progress(len(files))
    for file in files:
        recording = open_recording(file, calibration=calibration_of(settings))
        if recording.truth is None:
            raise ValueError(f"{file}: holds no truth to judge against")
        case, times = _run(settings, recording, recording.path.stem, [recording.imu], progress)
        judgement = compare(case, settings, progress.say)
        row = Row(case.name, recording.duration_s, judgement, stages=_stage_errors(settings, recording, case))
        page.add(row, case, recording.left, times)
        rows.append(row)
        progress.next()
    progress.finish()
    return _finish(rows, (), json, page)


def floor_mps(settings: Settings, recording: Recording) -> float | None:
    """AVE of the back end on perfect flow and depth, m/s; None unless the recording is a simulated one."""
    true_depth = true_depth_of(recording)
    if true_depth is None or recording.truth is None:
        return None
    from velod.runtime.offline import run_front_end

    front_end = FrontEnd()
    run_front_end(settings, recording.calibration, recording.packets(), front_end.note)
    perfect = with_perfect_flow_and_depth(front_end, recording.calibration, recording.truth, true_depth)
    velocities = estimate(perfect, settings, recording.calibration)
    return evaluate(velocities, recording.truth, recording.t_start_ns).ave_mps


def _simulated_row(
    settings: Settings, name: str, seconds: float, seeds: Sequence[int], progress: _Progress, page: Report | None
) -> Row:
    from velod.sim import sequence, simulated_recording
    from velod.sim.imu import sample_imu
    from velod.sim.run import true_motion

    recipe = sequence(name)

    def imus(seconds: float) -> list[Imu]:
        return [sample_imu(recipe.trajectory, recipe.imu, seconds, np.random.default_rng((k, 0))) for k in seeds]

    path = simulated_recording(name, seconds, _EVENT_SEED, lambda share: progress.show(f"{name}: simulating", share))
    recording = open_recording(path)
    case, times = _run(settings, recording, name, imus(seconds), progress)
    judgement = compare(case, settings, progress.say)
    imu_seconds = _IMU_SECONDS[name.split("-")[0]]
    progress.say(f"{name}: IMU alone over {imu_seconds:g} s")
    truth = true_motion(recipe.trajectory, imu_seconds)
    long = tuple(judge(integrate_imu(imu, truth, settings), imu, truth, 0) for imu in imus(imu_seconds))
    row = Row(name, seconds, judgement, imu_seconds, long, _stage_errors(settings, recording, case))
    if page is not None:
        page.add(row, case, recording.left, times)
    return row


def _run(
    settings: Settings, recording: Recording, name: str, imus: Sequence[Imu], progress: _Progress
) -> tuple[Case, StageTimes]:
    """Both front ends, velod's and the paper-like one, over a recording."""
    from velod.runtime.offline import run_offline
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

    packets = progress.along(recording, f"{name}: velod's front end")
    run_offline(settings, calibration, packets, note)
    begin_s = time.perf_counter()
    estimate(own, settings, calibration)
    back_end_s = time.perf_counter() - begin_s
    packets = progress.along(recording, f"{name}: paper-like front end")
    run_offline(paper, calibration, packets, like_paper.note)
    case = Case(
        name, calibration, recording.truth, recording.t_start_ns, imus,
        own, benosman.in_place_of(own), like_paper, true_depth_of(recording),
    )  # fmt: skip
    return case, clock.per_batch(len(own.selected), back_end_s)


def _stage_errors(settings: Settings, recording: Recording, case: Case) -> StageErrors | None:
    """Of velod's front end; None where the truth of it is not known."""
    return None if case.true_depth is None else stages_of(settings, recording, case.own, case.true_depth)


def _finish(rows: Sequence[Row], seeds: Sequence[int], json: str | None, page: Report | None) -> int:
    tables = {
        "AVE, m/s": ave_table(rows),
        "RVE (Eq. 16), %": rve_table(rows),
        "velod's own estimate, and dead reckoning": detail_table(rows),
        **overview_tables({row.name: row.stages for row in rows}),
    }
    text = "\n\n".join(f"{title}\n{text_table(lines)}" for title, lines in tables.items())
    # With --json - the table must not get into the JSON.
    print(f"{text}\n\n" + "\n".join(notes(rows, seeds)), file=sys.stderr if json == "-" else sys.stdout)
    if json is not None:
        write_json(json, {"velod": __version__, **as_json(rows, seeds)})
    if page is not None:
        tables |= group_tables({row.name: row.stages for row in rows})
        print(f"wrote {page.finish(tables, notes(rows, seeds))}", file=sys.stderr)
    failed = [row.name for row in rows if not all(j.ever_valid for j in row.judgement["velod"])]
    if failed:
        raise RunFailed(f"{', '.join(failed)}: no valid velocity")
    return 0


@dataclass(slots=True)
class _Clock:
    """Host time that flow and depth take, from the moments at which ``run_offline`` reports messages."""

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
        """All that is neither flow, depth nor back end is preprocessing, reading the file included."""
        total_s = self._last_s - self._begin_s - self._noted_s
        rest_s = total_s - self.flow_s - self.depth_s - back_end_s
        per_ms = 1e3 / max(1, batches)
        return StageTimes(rest_s * per_ms, self.flow_s * per_ms, self.depth_s * per_ms, back_end_s * per_ms)


class _Progress:
    """One line on a terminal: which of the sequences, what is being done, and how far that is."""

    def __init__(self, count: int) -> None:
        self._count, self._at = count, 1
        self._line = Line()
        self._what, self._since_s = "", time.monotonic()

    def show(self, what: str, share: float) -> None:
        if what != self._what:
            self._what, self._since_s = what, time.monotonic()
        if self._line.due():
            bar = progress_bar(share, time.monotonic() - self._since_s, width=20)
            self._line.draw(f"{self._at}/{self._count} {what} {bar}")

    def say(self, what: str) -> None:
        if self._line.enabled:
            self._line.draw(f"{self._at}/{self._count} {what}")

    def along(self, recording: Recording, what: str) -> Iterator[EventPacket | ImuPacket]:
        """The packets of a recording, while the bar grows."""
        length_ns = max(1, recording.t_end_ns - recording.t_start_ns)
        for packet in recording.packets():
            yield packet
            self.show(what, (packet.t_ns - recording.t_start_ns) / length_ns)

    def next(self) -> None:
        self._at += 1

    def finish(self) -> None:
        self._line.finish()
