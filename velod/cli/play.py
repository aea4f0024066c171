"""``velod replay``, ``eval``, ``demo`` and ``sim``: recordings through the stages, and what came out."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from velod.cli.config import calibration_of, settings_of
from velod.cli.exit import RunFailed, raise_if_interrupted
from velod.cli.report import (
    Line,
    VelocityLine,
    log_above,
    progress_bar,
    with_progress,
    write_csv,
    write_json,
)
from velod.cli.watch import losses
from velod.config import Settings
from velod.io import Chunking, Recording, open_recording
from velod.types import Velocity

if TYPE_CHECKING:
    from velod.eval.metrics import Metrics
    from velod.runtime.online import Published
    from velod.sim import Sequence


_SENSORS = ("calibration", "camera", "imu")  # first parts of the names of alarms


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """How a recording is played."""

    offline: bool = False
    speed: float = 1.0  # times real time; inf: as fast as it goes, nothing lost
    packets: str = "200hz"
    calibration: str | None = None  # a file instead of rig.calibration and of the recording's own


@dataclass(frozen=True, slots=True)
class Played:
    """What came out of a recording."""

    recording: Recording
    velocities: list[Velocity]
    real_time_factor: float  # sensor time over host time; NaN without velocities
    offline: bool
    latency_p50_ms: float | None = None  # batch closed to velocity out; None offline
    latency_p99_ms: float | None = None
    counters: dict[str, dict[str, int]] = field(default_factory=dict)  # by worker
    alarms: dict[str, str] = field(default_factory=dict)  # of sensors and calibration, at the end

    @property
    def why_not(self) -> str:
        """What kept the last velocity from being valid."""
        if not self.velocities:
            return "no velocity at all"
        last = self.velocities[-1]
        return f"{last.state}: {last.reason}"

    @property
    def rate_hz(self) -> float:
        """Velocities per second of sensor time from the first valid one on; NaN without."""
        first = next((i for i, v in enumerate(self.velocities) if v.valid), None)
        published = [] if first is None else self.velocities[first:]
        if len(published) < 2:
            return math.nan
        return (len(published) - 1) / ((published[-1].t_ns - published[0].t_ns) * 1e-9)


def replay(config: str | None, file: str, options: PlayOptions, csv: str | None) -> int:
    """Play a recording and say what came out. Raises RunFailed if that is no valid velocity."""
    played = play(settings_of(config, options.calibration), file, options)
    print(summary(played, _metrics(played)))
    if csv is not None:
        write_csv(csv, played.velocities)
    if not has_velocity(played):
        raise RunFailed(f"{file}: no valid velocity ({played.why_not})")
    return 0


def evaluate_files(
    config: str | None,
    files: list[str],
    options: PlayOptions,
    json: str | None,
    plot: str | None,
    *,
    floor: bool = False,
) -> int:
    """Judge recordings against the truth that they hold. Raises RunFailed if one yields no valid velocity."""
    if plot is not None:
        Path(plot).mkdir(parents=True, exist_ok=True)
    settings = settings_of(config, options.calibration)
    if settings.optimizer.frame != "imu":
        raise ValueError("optimizer.frame: must be 'imu' to be judged: the truth in recordings is the IMU's")
    rows, failed = [], []
    for file in files:
        played = play(settings, file, options)
        metrics = _metrics(played)
        if metrics is None:
            raise ValueError(f"{file}: holds no truth to judge against; `velod replay` needs none")
        floor_mps = _floor_mps(settings, played) if floor else None
        # With --json - the table must not get into the JSON.
        print(summary(played, metrics, floor_mps), file=sys.stderr if json == "-" else sys.stdout)
        rows.append(result_row(played, metrics, floor_mps))
        if not has_velocity(played):
            failed.append(f"{file}: no valid velocity ({played.why_not})")
        elif plot is not None:
            _plot(played, plot)
    if json is not None:
        write_json(json, rows if len(rows) > 1 else rows[0])
    if failed:
        raise RunFailed("; ".join(failed))
    return 0


def play(settings: Settings, file: str, options: PlayOptions) -> Played:
    """Run a recording through the stages, in one process or in several.

    Raises CalibrationError, RecordingError, SessionError, RunFailed, KeyboardInterrupt.
    """
    chunking = Chunking.parse(options.packets)
    recording = open_recording(file, calibration=calibration_of(settings))
    if options.offline:
        return _play_offline(settings, recording, chunking)
    return _play_online(settings, recording, options)


def _play_offline(settings: Settings, recording: Recording, chunking: Chunking) -> Played:
    from velod.runtime.offline import run_offline
    from velod.runtime.warmup import fill_cache

    # Compiling kernels, or loading what was compiled, is not here to be measured.
    fill_cache(settings, recording.calibration)
    counters: dict[str, dict[str, int]] = {}
    start_s = time.monotonic()
    packets = with_progress(recording.packets(chunking), recording.t_start_ns, recording.t_end_ns)
    alarms: dict[str, str] = {}
    velocities = run_offline(settings, recording.calibration, packets, counters=counters, alarms=alarms)
    factor = recording.duration_s / (time.monotonic() - start_s)
    return Played(recording, velocities, factor, offline=True, counters=counters, alarms=alarms)


def _play_online(settings: Settings, recording: Recording, options: PlayOptions) -> Played:
    from velod.runtime.online import OnlineError, run_online
    from velod.runtime.player import player_command
    from velod.runtime.worker import stop_on_signals

    lossless = math.isinf(options.speed)
    if lossless:
        settings = replace(
            settings,
            optimizer=replace(settings.optimizer, max_wait_ms=math.inf),
            zenoh=replace(settings.zenoh, lossless=True),
        )
    speed = None if lossless else options.speed
    driver = player_command(
        str(recording.path), settings.zenoh, settings.rig.name, speed, options.packets, settings.rig.calibration
    )
    live = VelocityLine()

    def show(p: Published) -> None:
        live.show(p.velocity, (p.t_pub_ns - p.t_origin_ns) * 1e-6 if p.t_origin_ns else math.nan)

    stop = stop_on_signals()
    log_above(live.line)
    try:
        result = run_online(settings, recording.calibration, driver, show, on_line=live.line.log_trouble, stop=stop)
    except OnlineError as e:
        raise RunFailed(str(e)) from None
    finally:
        live.line.finish()
    if stop.is_set():
        raise KeyboardInterrupt
    p50_ms, p99_ms = result.latency_percentiles_ms() or (None, None)
    return Played(
        recording,
        [p.velocity for p in result.velocities],
        _speed_of(result.velocities),
        offline=False,
        latency_p50_ms=p50_ms,
        latency_p99_ms=p99_ms,
        counters={worker: health.counters for worker, health in result.health.items()},
        alarms={
            name: text
            for health in result.health.values()
            for name, text in health.alarms.items()
            if name.split(".")[0] in _SENSORS  # others speak of the run's end: streams fell silent
        },
    )


def _speed_of(published: list[Published]) -> float:
    """Sensor time over host time between the first and the last velocity; NaN where there are not two."""
    if len(published) < 2 or published[-1].t_pub_ns <= published[0].t_pub_ns:
        return math.nan
    first, last = published[0], published[-1]
    return (last.velocity.t_ns - first.velocity.t_ns) / (last.t_pub_ns - first.t_pub_ns)


def _metrics(played: Played) -> Metrics | None:
    from velod.eval.metrics import evaluate

    if played.recording.truth is None or any(v.frame != "imu" for v in played.velocities):
        return None
    return evaluate(played.velocities, played.recording.truth, played.recording.t_start_ns)


def _floor_mps(settings: Settings, played: Played) -> float | None:
    from velod.cli.compare import floor_mps

    return floor_mps(settings, played.recording)


def _drift_percent(played: Played) -> float | None:
    """Of dead reckoning, relative to the distance; None without a truth or without two velocities."""
    from velod.eval.dead_reckoning import dead_reckoning

    recording = played.recording
    if recording.truth is None or any(v.frame != "imu" for v in played.velocities):
        return None
    track = dead_reckoning(played.velocities, recording.imu, recording.truth)
    return None if track is None else track.drift_percent


def result_row(played: Played, metrics: Metrics, floor_mps: float | None = None) -> dict[str, float | int | None]:
    """One result as ``--json`` writes it; what is not known is null."""
    return metrics.row(
        ave_floor_mps=floor_mps,
        drift_percent=_drift_percent(played),
        real_time_factor=played.real_time_factor,
        latency_p50_ms=played.latency_p50_ms,
        latency_p99_ms=played.latency_p99_ms,
    )


def summary(played: Played, metrics: Metrics | None, floor_mps: float | None = None) -> str:
    """What a run was and what came out of it, for people."""
    r = played.recording
    how = "one process" if played.offline else "four stages, processes of their own"
    lines = [
        f"{r.path}: {r.duration_s:.3f} s, {r.n_events * 1e-6:.2f} M events; {how}, "
        f"{played.real_time_factor:.2f} x real time"
    ]
    lines.append(metrics.summary() if metrics is not None else _without_truth(played))
    drift_percent = _drift_percent(played)
    if drift_percent is not None:
        lines.append(f"drift          {drift_percent:8.2f} %     (of the distance, by dead reckoning)")
    if floor_mps is not None:
        lines.append(f"floor          {floor_mps:8.4f} m/s   (AVE with perfect flow and depth)")
    if math.isfinite(played.rate_hz):
        lines.append(f"rate           {played.rate_hz:8.2f} Hz")
    if played.latency_p50_ms is not None and played.latency_p99_ms is not None:
        lines.append(
            f"latency        {played.latency_p50_ms:8.2f} ms    (p50; p99 {played.latency_p99_ms:.2f} ms; "
            "from a batch's end to the velocity that used it)"
        )
    lost = _losses(played.counters)
    lines += [f"dropped        {worker}: {text}" for worker, text in lost] or ["dropped        nothing"]
    lines += [f"ALARM          {name}: {text}" for name, text in sorted(played.alarms.items())]
    return "\n".join(lines)


def _without_truth(played: Played) -> str:
    from velod.eval.metrics import median_direction, median_speed_mps

    valid = sum(v.valid for v in played.velocities)
    if not valid:
        return f"velocities     {len(played.velocities):8d}       (none valid)"
    x, y, z = median_direction(played.velocities)
    return (
        f"median speed   {median_speed_mps(played.velocities):8.4f} m/s   "
        f"(direction {x:+.3f} {y:+.3f} {z:+.3f} in B)\n"
        f"velocities     {len(played.velocities):8d}       ({valid} valid)"
    )


def _losses(counters: dict[str, dict[str, int]]) -> list[tuple[str, str]]:
    """Workers that lost something, with what by cause."""
    found = []
    for worker, counts in sorted(counters.items()):
        gaps, drops = losses(counts)
        lost = sorted({**gaps, **drops}.items())
        if lost:
            found.append((worker, ", ".join(f"{name} {n}" for name, n in lost)))
    return found


def _plot(played: Played, directory: str) -> None:
    from velod.eval.plots import plot_run

    for path in plot_run(played.velocities, played.recording.truth, directory, Path(played.recording.path).stem):
        print(f"wrote {path}", file=sys.stderr)


def has_velocity(played: Played) -> bool:
    """Whether anything usable came out."""
    return any(v.valid for v in played.velocities)


# --- simulated sensors ---

# What a demo must reach; corridors and boxes give 0.03 to 0.05 m/s, spins of 13 rad/s twice as much.
_DEMO_AVE_MPS = {"corridor": 0.1, "boxes": 0.1, "spin": 0.2}
_DEMO_VALID = 0.9
_DEMO_RATE_SHARE = 0.95


def simulate_to_file(recipe: Sequence, path: str, seconds: float, seed: int) -> int:
    """Record a simulated sequence. Raises RecordingError."""
    from velod.sim import simulate

    with _Bar(f"simulating {seconds:g} s of {recipe.name}") as bar:
        simulate(recipe, seconds, seed, path, bar.show)
    print(f"wrote {path}")
    return 0


def demo(config: str | None, name: str, seconds: float, seed: int, csv: str | None, json: str | None) -> int:
    """Simulated sensors through the service. Raises RunFailed where the result is not as it should be."""
    from velod.sim import simulated_recording

    settings = settings_of(config, calibration="")  # the simulated rig brings its own
    with _Bar(f"simulating {seconds:g} s of {name}") as bar:
        path = simulated_recording(name, seconds, seed, bar.show)
    print(f"{seconds:g} s of {name} in real time: a driver, ingest, flow, depth, optimizer", file=sys.stderr)
    played = play(settings, str(path), PlayOptions())
    metrics = _metrics(played)
    assert metrics is not None, "a simulated recording holds the truth"
    if csv is not None:
        write_csv(csv, played.velocities)
    print(summary(played, metrics), file=sys.stderr if json == "-" else sys.stdout)
    if json is not None:
        write_json(json, result_row(played, metrics))
    limit_mps = _DEMO_AVE_MPS[name.split("-")[0]]
    if missing := shortcomings(played, metrics, settings.optimizer.output_hz, limit_mps):
        raise RunFailed("; ".join(missing))
    return 0


def shortcomings(played: Played, metrics: Metrics, output_hz: float, limit_mps: float) -> list[str]:
    """What a demo's result lacks; empty for a good one."""
    if not has_velocity(played):
        return [f"no valid velocity ({played.why_not})"]
    found = []
    if not metrics.ave_mps <= limit_mps:
        found.append(f"AVE {metrics.ave_mps:.3f} m/s, at most {limit_mps:g} belongs there")
    if not metrics.valid_fraction >= _DEMO_VALID:
        found.append(f"only {100 * metrics.valid_fraction:.0f} % of the velocities are valid")
    if not played.rate_hz >= _DEMO_RATE_SHARE * output_hz:
        found.append(f"{played.rate_hz:.1f} velocities per second instead of {output_hz:g}")
    return found


class _Bar:
    """A progress bar on stderr for work that tells its share; one plain line where that is no terminal.

    Work that need not be done, and tells no share, is not mentioned.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._line = Line()
        self._start_s = time.monotonic()
        self._said = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._line.finish()

    def show(self, share: float) -> None:
        raise_if_interrupted()
        if not self._line.enabled and not self._said:
            print(self._what, file=sys.stderr)
            self._said = True
        if self._line.due():
            self._line.draw(f"{self._what} {progress_bar(share, time.monotonic() - self._start_s)}")
