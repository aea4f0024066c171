"""``velod eval --table``, ``--report`` and ``--floor``: velod beside its baselines and the paper's numbers."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

from velod import __version__
from velod.cli.cases import Outcome, SequenceJob, judge_recording
from velod.cli.config import calibration_of, settings_of
from velod.cli.exit import RunFailed, raise_if_interrupted
from velod.cli.files import write_json
from velod.cli.jobs import commit, run_jobs
from velod.cli.line import Line, progress_bar
from velod.cli.stages import true_depth_of
from velod.config import Settings
from velod.eval.floor import with_perfect_flow_and_depth
from velod.eval.front_end import FrontEnd, estimate
from velod.eval.markdown import put_into, require_place
from velod.eval.metrics import evaluate
from velod.eval.report import Report
from velod.eval.table import all_tables, as_json, more_tables, notes, text_table
from velod.io import Recording, open_recording

_SEEDS = (1, 2, 3, 4, 5)
_QUICK_SEEDS = (1,)
_SECONDS = {"spin": 3.0}
_QUICK_SECONDS = {"spin": 0.6}
_OTHER_SECONDS, _OTHER_QUICK_SECONDS = 10.0, 1.0
# As long as the paper's must have been for its errors of IMU integration.
_IMU_SECONDS = {"corridor": 90.0}
_OTHER_IMU_SECONDS = 30.0
_IMU_NOISES, _QUICK_IMU_NOISES = 100, 20


@dataclass(frozen=True, slots=True)
class Output:
    """Where the results go; None: nowhere."""

    json: str | None = None  # - for stdout
    report: str | None = None  # a directory
    markdown: str | None = None  # a file in which the block of these tables is replaced


@dataclass(frozen=True, slots=True)
class TableOptions:
    """What ``--table`` runs, and how."""

    table: str  # "synthetic" or "held-out"
    quick: bool = False
    event_seed: int = 1
    texture_seed: int | None = None
    processes: int = 2

    @property
    def command(self) -> str:
        """What can be typed to have it again."""
        parts = ["velod eval --table", self.table, "--quick" if self.quick else ""]
        parts.append(f"--seed {self.event_seed}" if self.event_seed != 1 else "")
        parts.append(f"--texture {self.texture_seed}" if self.texture_seed is not None else "")
        return " ".join(part for part in parts if part)


def compare_sequences(config: str | None, options: TableOptions, output: Output) -> int:
    """Simulated sequences. Raises RunFailed where one fails, or yields no valid velocity."""
    from velod.sim import HELD_OUT, TABLE_I

    names = TABLE_I if options.table == "synthetic" else HELD_OUT
    settings = settings_of(config)
    seeds = _QUICK_SEEDS if options.quick else _SEEDS
    page = _page(output, options.command)
    jobs = [_job(name, settings, options, seeds, draw=page is not None) for name in names]
    return _finish(run_jobs(jobs, options.processes), seeds, output, page, options.command)


def compare_files(config: str | None, files: Sequence[str], output: Output, calibration: str | None = None) -> int:
    """Recordings that hold the truth. Raises RunFailed where one yields no valid velocity."""
    settings = settings_of(config, calibration)
    command = f"velod eval {' '.join(files)} --report"
    page = _page(output, command)
    outcomes = []
    for at, file in enumerate(files):
        recording = open_recording(file, calibration=calibration_of(settings))
        if recording.truth is None:
            raise ValueError(f"{file}: holds no truth to judge against")
        name, line = recording.path.stem, _OneLine(f"{at + 1}/{len(files)} {recording.path.stem}")
        outcomes.append(judge_recording(name, settings, recording, [recording.imu], line.show, draw=page is not None))
        line.finish()
    return _finish(outcomes, (), output, page, command)


def floor_mps(settings: Settings, recording: Recording) -> float | None:
    """AVE of the back end on perfect flow and depth, m/s; None where the recording does not hold the true depth."""
    true_depth = true_depth_of(recording)
    if true_depth is None or recording.truth is None:
        return None
    from velod.runtime.offline import run_front_end

    front_end = FrontEnd()
    run_front_end(settings, recording.calibration, recording.packets(), front_end.note)
    perfect = with_perfect_flow_and_depth(front_end, recording.calibration, recording.truth, true_depth)
    velocities = estimate(perfect, settings, recording.calibration)
    return evaluate(velocities, recording.truth, recording.t_start_ns).ave_mps


def _job(name: str, settings: Settings, options: TableOptions, seeds: tuple[int, ...], *, draw: bool) -> SequenceJob:
    kind = name.split("-")[0]
    lengths, other = (_QUICK_SECONDS, _OTHER_QUICK_SECONDS) if options.quick else (_SECONDS, _OTHER_SECONDS)
    return SequenceJob(
        name=name,
        settings=settings,
        seconds=lengths.get(kind, other),
        event_seed=options.event_seed,
        texture_seed=options.texture_seed,
        imu_seeds=seeds,
        imu_seconds=_IMU_SECONDS.get(kind, _OTHER_IMU_SECONDS),
        imu_noises=_QUICK_IMU_NOISES if options.quick else _IMU_NOISES,
        draw=draw,
    )


def _page(output: Output, command: str) -> Report | None:
    """The page, where one is wanted. What cannot be written is known before the work: MarkdownError, OSError."""
    if output.markdown is not None:
        require_place(output.markdown, command)
    return None if output.report is None else Report(output.report, f"{command} (velod {__version__}, {commit()})")


def _finish(
    outcomes: Sequence[Outcome], seeds: Sequence[int], output: Output, page: Report | None, command: str
) -> int:
    rows = [outcome.row for outcome in outcomes]
    tables, said = all_tables(rows), notes(rows, seeds)
    text = "\n\n".join(f"{title}\n{text_table(lines)}" for title, lines in tables.items())
    # With --json - the table must not get into the JSON.
    print(f"{text}\n\n" + "\n".join(said), file=sys.stderr if output.json == "-" else sys.stdout)
    if output.json is not None:
        write_json(
            output.json, {"velod": __version__, "commit": commit(), "command": command, **as_json(rows, seeds)}
        )
    if output.markdown is not None:
        put_into(output.markdown, command, commit(), tables, said)
        print(f"wrote {output.markdown}", file=sys.stderr)
    if page is not None:
        for outcome in outcomes:
            assert outcome.section is not None, "drawn for the page"
            page.add(outcome.section)
        print(f"wrote {page.finish({**tables, **more_tables(rows)}, said)}", file=sys.stderr)
    failed = [row.name for row in rows if not all(j.ever_valid for j in row.judgement["velod"])]
    if failed:
        raise RunFailed(f"{', '.join(failed)}: no valid velocity")
    return 0


class _OneLine:
    """What is being done with one recording, on a terminal."""

    def __init__(self, name: str) -> None:
        self._name, self._line = name, Line()
        self._what, self._since_s = "", time.monotonic()

    def show(self, what: str, share: float) -> None:
        raise_if_interrupted()
        if what != self._what:
            self._what, self._since_s = what, time.monotonic()
        if self._line.due():
            bar = progress_bar(share, time.monotonic() - self._since_s, width=20) if share == share else ""
            self._line.draw(f"{self._name}: {what} {bar}")

    def finish(self) -> None:
        self._line.finish()
