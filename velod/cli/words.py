"""A velocity in words, for people."""

from __future__ import annotations

import math

import numpy as np

from velod.types import Velocity


def describe_velocity(v: Velocity, rate_hz: float = math.nan, latency_ms: float = math.nan) -> str:
    """One line for people, e.g. ``t  12.345 s  |v|  5.678 +- 0.031 m/s  [...]  75.0 Hz  8.1 ms  tracking``."""
    parts = [f"t {v.t_ns * 1e-9:9.3f} s"]
    if v.valid:
        speed, sigma = speed_and_sigma(v)
        parts.append(f"|v| {speed:6.3f} ± {sigma:.3f} m/s  [{v.v_B[0]:+.3f} {v.v_B[1]:+.3f} {v.v_B[2]:+.3f}]")
    else:
        parts.append("|v|    --")
    if math.isfinite(rate_hz):
        parts.append(f"{rate_hz:5.1f} Hz")
    if math.isfinite(latency_ms):
        parts.append(f"{latency_ms:5.1f} ms")
    parts.append(f"{v.state}: {v.reason}" if v.reason else str(v.state))
    return "  ".join(parts)


def describe_attitude(v: Velocity) -> str:
    """Frame, up and age, for people, e.g. ``imu  up [+0.00 -1.00 +0.02] ± 0.4°  age 23.1 ms``."""
    parts = [v.frame]
    if math.isfinite(sigma := up_sigma(v)):
        parts.append(f"up [{v.up_B[0]:+.2f} {v.up_B[1]:+.2f} {v.up_B[2]:+.2f}] ± {math.degrees(sigma):.1f}°")
    if math.isfinite(v.age_ms):
        parts.append(f"age {v.age_ms:.1f} ms")
    return "  ".join(parts)


def speed_and_sigma(v: Velocity) -> tuple[float, float]:
    """|v| and its standard deviation to first order, m/s."""
    speed = float(np.linalg.norm(v.v_B))
    along = v.v_B / speed if speed > 1e-9 else np.full(3, math.sqrt(1.0 / 3.0))
    return speed, math.sqrt(max(0.0, float(along @ v.cov @ along)))


def up_sigma(v: Velocity) -> float:
    """Of the direction of up in B, where it is known worst, rad; NaN where up is not known."""
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(v.up_cov)[-1]))) if np.isfinite(v.up_cov).all() else math.nan
