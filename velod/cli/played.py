"""What came out of a recording that was played: numbers, words, and what it lacks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from velod.cli.top import losses
from velod.io import Recording
from velod.types import Velocity

if TYPE_CHECKING:
    from velod.eval.metrics import Metrics

# What a demo must reach besides its AVE: of the velocities, and of the output rate.
_DEMO_VALID = 0.9
_DEMO_RATE_SHARE = 0.95


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


def metrics_of(played: Played) -> Metrics | None:
    """Its error; None where the recording holds no truth, or the velocities are not the IMU's."""
    from velod.eval.metrics import evaluate

    if played.recording.truth is None or any(v.frame != "imu" for v in played.velocities):
        return None
    return evaluate(played.velocities, played.recording.truth, played.recording.t_start_ns)


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


def has_velocity(played: Played) -> bool:
    """Whether anything usable came out."""
    return any(v.valid for v in played.velocities)


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
