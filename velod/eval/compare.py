"""velod and its baselines on one recording, for several noises of the IMU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from velod.config import Settings
from velod.eval.baselines import integrate_imu, paper_settings, solve_linear
from velod.eval.dead_reckoning import Track, dead_reckoning
from velod.eval.floor import with_perfect_flow_and_depth
from velod.eval.front_end import FrontEnd, estimate
from velod.eval.metrics import MIN_SPEED_MPS, Metrics, evaluate, truth_at
from velod.eval.scene_truth import TrueDepth
from velod.geometry.calibration import Calibration
from velod.io.model import Imu, Truth
from velod.types import F64, I64, Velocity

METHODS = {
    "velod": "velod",
    "floor": "velod's back end on perfect flow and depth",
    "paper-like": "the settings that the paper names",
    "linear": "Eq. 15 on each batch alone",
    "Benosman-NF": "velod with the per-component reciprocal as flow",
    "IMU": "integrated from the true velocity and attitude",
}
"""In the order of the tables."""


@dataclass(frozen=True, slots=True)
class Case:
    """A recording to be judged, and what the front end made of it."""

    name: str
    calibration: Calibration
    truth: Truth
    t_start_ns: int
    imus: Sequence[Imu]  # one for each seed, all sampled at the same times
    own: FrontEnd
    benosman: FrontEnd
    paper: FrontEnd
    true_depth: TrueDepth | None = None  # None: not a simulated recording, no floor


@dataclass(frozen=True, slots=True)
class Judged:
    """One method on one recording with one noise of the IMU."""

    velocities: list[Velocity]  # those that were judged
    metrics: Metrics
    track: Track | None
    ever_valid: bool  # False: none was valid, and all with any batch in them were judged

    def errors(self, truth: Truth) -> tuple[I64, F64, F64]:
        """Times (n,) ns, |v_gt - v_est| (n,) m/s, and Eq. 16 (n,) %, NaN where nothing moves."""
        inside = [v for v in self.velocities if truth.t_ns[0] <= v.t_ns <= truth.t_ns[-1]]
        t_ns = np.array([v.t_ns for v in inside], dtype=np.int64)
        v_gt = truth_at(truth, t_ns)
        error = np.linalg.norm(v_gt - np.array([v.v_B for v in inside]).reshape(-1, 3), axis=1)
        speed = np.linalg.norm(v_gt, axis=1)
        # Eq. 16
        relative = np.where(speed >= MIN_SPEED_MPS, 100.0 * error / np.maximum(speed, MIN_SPEED_MPS), np.nan)
        return t_ns, error, relative


Judgement = dict[str, list[Judged]]
"""Method -> one Judged for each noise of the IMU; a method that cannot be had is missing."""


def compare(case: Case, settings: Settings, step: Callable[[str], None] | None = None) -> Judgement:
    """Every method with every IMU of ``case``. ``step`` is told what comes next."""
    paper = paper_settings(settings)
    perfect = None
    if case.true_depth is not None:
        _tell(step, f"{case.name}: perfect flow and depth")
        perfect = with_perfect_flow_and_depth(case.own, case.calibration, case.truth, case.true_depth)
    found: Judgement = {}
    for k, imu in enumerate(case.imus):
        _tell(step, f"{case.name}: IMU {k + 1} of {len(case.imus)}")
        runs = {
            "velod": estimate(case.own.with_imu(imu), settings, case.calibration),
            "paper-like": estimate(case.paper.with_imu(imu), paper, case.calibration),
            "linear": solve_linear(case.own.with_imu(imu), settings, case.calibration),
            "Benosman-NF": estimate(case.benosman.with_imu(imu), settings, case.calibration),
            "IMU": integrate_imu(imu, case.truth, settings),
        }
        if perfect is not None:
            runs["floor"] = estimate(perfect.with_imu(imu), settings, case.calibration)
        for method, velocities in runs.items():
            found.setdefault(method, []).append(judge(velocities, imu, case.truth, case.t_start_ns))
    return {method: found[method] for method in METHODS if method in found}


def without_velocities(judgement: Judgement) -> Judgement:
    """What tables need of it: a hundredth of the size."""
    return {method: [replace(j, velocities=[]) for j in runs] for method, runs in judgement.items()}


def judge(velocities: Sequence[Velocity], imu: Imu, truth: Truth, t_start_ns: int) -> Judged:
    """Judge what a method put out, from its first valid velocity on.

    The paper's estimates carry no validity: where none is valid, every velocity that a batch went into counts.
    """
    first = next((i for i, v in enumerate(velocities) if v.valid), None)
    ever_valid = first is not None
    judged = (
        list(velocities[first:]) if ever_valid else [replace(v, valid=True) for v in velocities if v.batch_seq >= 0]
    )
    return Judged(judged, evaluate(judged, truth, t_start_ns), dead_reckoning(judged, imu, truth), ever_valid)


def _tell(step: Callable[[str], None] | None, what: str) -> None:
    if step is not None:
        step(what)
