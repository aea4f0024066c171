"""``velod replay`` and ``eval``: recordings through the stages, and what came out."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from velod.cli.config import calibration_of, settings_of
from velod.cli.exit import RunFailed
from velod.cli.files import write_csv, write_json
from velod.cli.line import VelocityLine, log_above, with_progress
from velod.cli.played import Played, has_velocity, metrics_of, result_row, summary
from velod.config import Settings
from velod.io import Chunking, Recording, open_recording

if TYPE_CHECKING:
    from velod.runtime.online import OnlineResult, Published


_SENSORS = ("calibration", "camera", "imu")  # first parts of the names of alarms


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """How a recording is played."""

    offline: bool = False
    speed: float = 1.0  # times real time; inf: as fast as it goes, nothing lost
    packets: str = "200hz"
    calibration: str | None = None  # a file instead of rig.calibration and of the recording's own


def replay(config: str | None, file: str, options: PlayOptions, csv: str | None) -> int:
    """Play a recording and say what came out. Raises RunFailed if that is no valid velocity."""
    played = play(settings_of(config, options.calibration), file, options)
    print(summary(played, metrics_of(played)))
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
        metrics = metrics_of(played)
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

    speed = None if math.isinf(options.speed) else options.speed
    if speed is None:
        settings = _lossless(settings)
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
    return _played_online(recording, result)


def _lossless(settings: Settings) -> Settings:
    """Wait for whatever is slow, and lose nothing."""
    optimizer, zenoh = replace(settings.optimizer, max_wait_ms=math.inf), replace(settings.zenoh, lossless=True)
    return replace(settings, optimizer=optimizer, zenoh=zenoh)


def _played_online(recording: Recording, result: OnlineResult) -> Played:
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


def _floor_mps(settings: Settings, played: Played) -> float | None:
    from velod.cli.compare import floor_mps

    return floor_mps(settings, played.recording)


def _plot(played: Played, directory: str) -> None:
    from velod.eval.plots import plot_run

    for path in plot_run(played.velocities, played.recording.truth, directory, Path(played.recording.path).stem):
        print(f"wrote {path}", file=sys.stderr)
