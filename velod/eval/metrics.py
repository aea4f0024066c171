"""How far the published velocities are from the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from velod.io.model import Truth
from velod.types import F64, I64, NS_PER_S, Velocity

MIN_SPEED_MPS = 1e-3
"""Below this true speed the relative error (Eq. 16) is not defined and the sample is left out of it."""


@dataclass(frozen=True, slots=True)
class Metrics:
    """Accuracy over every velocity published from the first valid one on, within the truth's span.

    Causal: each velocity is judged as it was published. Where nothing could be judged, ``n`` is 0 and the rest NaN.
    """

    n: int  # velocities judged
    ave_mps: float  # mean |v_gt - v_est| (AVE)
    rve_percent: float  # mean of Eq. 16 (RVE)
    rve_quartiles_percent: tuple[float, float, float]  # 25, 50 and 75 %
    rve_p95_percent: float
    median_mps: float
    p95_mps: float
    max_mps: float
    first_valid_s: float  # since the start of the recording
    valid_fraction: float  # of the velocities from the first valid one on
    nees_mean: float  # e^T cov^-1 e of the valid ones; 3 for an honest covariance
    within_1_sigma: float  # share with e^T cov^-1 e <= 1; 0.199 for an honest covariance
    within_2_sigma: float  # <= 4; 0.739
    within_3_sigma: float  # <= 9; 0.971
    median_speed_mps: float  # of the estimate
    median_true_speed_mps: float

    def row(
        self,
        *,
        ave_floor_mps: float | None = None,
        drift_percent: float | None = None,
        real_time_factor: float | None = None,
        latency_p50_ms: float | None = None,
        latency_p99_ms: float | None = None,
    ) -> dict[str, float | int | None]:
        """The fields of ``velod eval --json``; what could not be computed is None."""
        values: dict[str, float | int | None] = {
            "ave_mps": self.ave_mps,
            "rve_percent": self.rve_percent,
            "p95_mps": self.p95_mps,
            "n": self.n,
            "first_valid_s": self.first_valid_s,
            "valid_fraction": self.valid_fraction,
            "ave_floor_mps": ave_floor_mps,
            "nees_mean": self.nees_mean,
            "drift_percent": drift_percent,
            "real_time_factor": real_time_factor,
            "latency_p50_ms": latency_p50_ms,
            "latency_p99_ms": latency_p99_ms,
            "median_mps": self.median_mps,
            "rve_median_percent": self.rve_quartiles_percent[1],
            "rve_p95_percent": self.rve_p95_percent,
            "within_1_sigma": self.within_1_sigma,
            "within_2_sigma": self.within_2_sigma,
            "within_3_sigma": self.within_3_sigma,
        }
        return {key: v if v is not None and math.isfinite(v) else None for key, v in values.items()}

    def summary(self) -> str:
        """A small table for people."""
        if self.n == 0:
            return "no valid velocity within the span of the truth"
        shares = " / ".join(f"{100 * s:.0f}" for s in (self.within_1_sigma, self.within_2_sigma, self.within_3_sigma))
        return "\n".join(
            (
                f"AVE            {self.ave_mps:8.4f} m/s   (median {self.median_mps:.4f}, 95 % {self.p95_mps:.4f}, "
                f"largest {self.max_mps:.4f})",
                f"RVE            {self.rve_percent:8.2f} %     (median {self.rve_quartiles_percent[1]:.2f}, 95 % "
                f"{self.rve_p95_percent:.2f})",
                f"median speed   {self.median_speed_mps:8.4f} m/s   (truth {self.median_true_speed_mps:.4f})",
                f"velocities     {self.n:8d}       ({100 * self.valid_fraction:.1f} % valid, the first after "
                f"{self.first_valid_s:.3f} s)",
                f"NEES           {self.nees_mean:8.2f}       (3 is honest; {shares} % within 1 / 2 / 3 sigma, "
                "honest: 20 / 74 / 97 %)",
            )
        )


def evaluate(velocities: Sequence[Velocity], truth: Truth, t_start_ns: int | None = None) -> Metrics:
    """Compare velocities with the truth, linearly interpolated at the estimate's time.

    ``t_start_ns``: start of the recording (None: of the truth). Velocities before the first valid one are start-up;
    later invalid ones count in ``valid_fraction``, and in the errors too as far as they carry numbers.
    """
    start_ns = int(truth.t_ns[0]) if t_start_ns is None else t_start_ns
    first = next((i for i, v in enumerate(velocities) if v.valid), None)
    if first is None:
        return _nothing(math.nan, 0.0)
    published = velocities[first:]
    first_valid_s = (published[0].t_ns - start_ns) / NS_PER_S
    valid_fraction = sum(v.valid for v in published) / len(published)
    judged = [
        v
        for v in published
        if truth.t_ns[0] <= v.t_ns <= truth.t_ns[-1] and (v.valid or bool(np.isfinite(v.v_B).all()))
    ]
    if not judged:
        return _nothing(first_valid_s, valid_fraction)
    v_est = np.array([v.v_B for v in judged])
    v_gt = truth_at(truth, np.array([v.t_ns for v in judged], dtype=np.int64))
    error = np.linalg.norm(v_gt - v_est, axis=1)
    speed = np.linalg.norm(v_gt, axis=1)
    moving = speed >= MIN_SPEED_MPS
    # Eq. 16
    rve = 100.0 * error[moving] / speed[moving]
    valid = np.array([v.valid for v in judged])
    squared = nees((v_est - v_gt)[valid], np.array([v.cov for v in judged])[valid])
    return Metrics(
        n=len(judged),
        ave_mps=float(error.mean()),
        rve_percent=_mean(rve),
        rve_quartiles_percent=(_percentile(rve, 25), _percentile(rve, 50), _percentile(rve, 75)),
        rve_p95_percent=_percentile(rve, 95),
        median_mps=float(np.median(error)),
        p95_mps=float(np.percentile(error, 95)),
        max_mps=float(error.max()),
        first_valid_s=first_valid_s,
        valid_fraction=valid_fraction,
        nees_mean=_mean(squared),
        within_1_sigma=_mean(squared <= 1.0),
        within_2_sigma=_mean(squared <= 4.0),
        within_3_sigma=_mean(squared <= 9.0),
        median_speed_mps=float(np.median(np.linalg.norm(v_est, axis=1))),
        median_true_speed_mps=float(np.median(speed)),
    )


def truth_at(truth: Truth, t_ns: I64) -> F64:
    """True v_B, (n, 3) m/s, linearly interpolated at ``t_ns``, which must lie within the truth's span."""
    return interpolated(truth.t_ns, truth.v_B, t_ns)


def interpolated(known_t_ns: I64, values: F64, t_ns: I64) -> F64:
    """Columns of ``values`` (k, c), known at ``known_t_ns``, linearly interpolated at ``t_ns`` (n,): (n, c)."""
    # Relative to the first sample: float64 holds ns exactly over 100 days only.
    at, known = (t_ns - known_t_ns[0]).astype(np.float64), (known_t_ns - known_t_ns[0]).astype(np.float64)
    return np.stack([np.interp(at, known, column) for column in values.T], axis=1)


def nees(error: F64, cov: F64) -> F64:
    """Normalised estimation error squared e^T cov^-1 e, (n,), of errors (n, 3) and covariances (n, 3, 3).

    Infinite where a covariance is not positive definite.
    """
    squared = np.full(len(error), np.inf)
    usable = np.flatnonzero(np.isfinite(cov).all(axis=(1, 2)))
    usable = usable[np.linalg.eigvalsh(cov[usable])[:, 0] > 0.0]
    e = error[usable]
    squared[usable] = np.einsum("ni,ni->n", e, np.linalg.solve(cov[usable], e[:, :, None])[:, :, 0])
    return squared


def median_speed_mps(velocities: Sequence[Velocity]) -> float:
    """Median of |v| over the valid velocities; NaN without any."""
    v = _valid(velocities)
    return float(np.median(np.linalg.norm(v, axis=1))) if len(v) else math.nan


def median_direction(velocities: Sequence[Velocity]) -> F64:
    """Unit vector (3,) in B along the component-wise median of the valid velocities' directions; NaN without any."""
    v = _valid(velocities)
    if len(v) == 0:
        return np.full(3, np.nan)
    middle = np.median(v / np.linalg.norm(v, axis=1, keepdims=True), axis=0)
    direction: F64 = middle / np.linalg.norm(middle)
    return direction


def angle_deg(a: F64, b: F64) -> float:
    """Angle between two vectors (3,), degrees."""
    cosine = float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b))
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def _valid(velocities: Sequence[Velocity]) -> F64:
    return np.array([v.v_B for v in velocities if v.valid], dtype=np.float64).reshape(-1, 3)


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else math.nan


def _percentile(values: F64, percent: float) -> float:
    return float(np.percentile(values, percent)) if len(values) else math.nan


def _nothing(first_valid_s: float, valid_fraction: float) -> Metrics:
    nan = math.nan
    errors = (nan, nan, (nan, nan, nan), nan, nan, nan, nan)
    return Metrics(0, *errors, first_valid_s, valid_fraction, nan, nan, nan, nan, nan, nan)
