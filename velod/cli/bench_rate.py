"""``velod bench rate``: how many events all processes together take in as they come, by the size of the sensor."""

from __future__ import annotations

import numpy as np

from velod.cli.exit import RunFailed
from velod.cli.through_processes import through_the_processes
from velod.config import Settings
from velod.eval import bench_input
from velod.eval.bench import Result
from velod.runtime.online import OnlineResult

RATES_MEV_S = ((bench_input.RIG, 16.0), (bench_input.VGA_RIG, 20.0), (bench_input.LARGE_RIG, 20.0))
"""Rigs, and the events of both their cameras that are offered, M/s."""
NAMES = tuple(f"rate.{rig.left.width}x{rig.left.height}" for rig, _ in RATES_MEV_S)


def rate(seconds: float) -> list[Result]:
    """``rate.*``: in real time, with what is too much left to the budget.

    Time from a batch's closing to its velocity. ``mev_s``: events that ingest looked at, ``offered_mev_s``: that came
    in all, ``batches_percent``: batches that were made, ``age_p99_ms``: of the velocities, ``error_mps``: their mean
    distance from the truth from the first valid one on. Raises RunFailed, SessionError.
    """
    results = []
    for name, (rig, mev_s) in zip(NAMES, RATES_MEV_S, strict=True):
        speed_px_s = bench_input.speed_for(0.5e6 * mev_s, rig.left)
        run, events = through_the_processes(Settings(), seconds, 1.0, speed_px_s=speed_px_s, rig=rig)
        latency_ms = run.latency_ms()
        if not len(latency_ms):
            raise RunFailed(f"{name}: no velocity was made of a batch")
        p50_us, p99_us = (1e3 * float(ms) for ms in np.percentile(latency_ms, (50, 99)))
        counted = run.health["ingest-0"].counters
        looked_at, made, shed = (counted.get(of, 0) for of in ("events", "batches", "shed.batches"))
        more = {
            "offered_mev_s": 1e-6 * events / seconds,
            "batches_percent": 100.0 * made / max(1, made + shed),
            "flows_hz": run.health["flow-0"].counters.get("flows", 0) / seconds,
            **_quality(run, bench_input.true_velocity(speed_px_s, rig)),
        }
        results.append(
            Result(name, p50_us, len(latency_ms), mev_s=1e-6 * looked_at / seconds, p99_us=p99_us, more=more)
        )
    return results


def _quality(run: OnlineResult, v_B: np.ndarray) -> dict[str, float]:
    """Age and error of the velocities from the first valid one on; ``v_B`` (3,) is the true one, m/s."""
    valid = [p.velocity for p in run.velocities if p.velocity.valid]
    if not valid:
        return {}
    since = [p.velocity for p in run.velocities if p.velocity.t_ns >= valid[0].t_ns]
    error_mps = np.linalg.norm([v.v_B - v_B for v in since], axis=1)
    return {
        "age_p99_ms": float(np.percentile([v.age_ms for v in since], 99)),
        "error_mps": float(error_mps.mean()),
    }
