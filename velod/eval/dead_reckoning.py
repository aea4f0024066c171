"""Dead reckoning: one integration of the velocity, turned into the world by the gyroscope (Sec. V-D, Fig. 8)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from velod.eval.metrics import interpolated
from velod.geometry.so3 import exp, log, matrix_from_quaternion
from velod.io.model import Imu, Truth
from velod.optimizer.inertial import InertialMemory
from velod.types import F64, I64, NS_PER_S, Velocity


@dataclass(frozen=True, slots=True)
class Track:
    """Positions in W by dead reckoning, and the true ones; both begin at the same point."""

    t_ns: I64  # (n,)
    p_WB: F64  # (n, 3) m
    true_p_WB: F64  # (n, 3) m

    @property
    def distance_m(self) -> float:
        """Length of the true path."""
        return float(np.linalg.norm(np.diff(self.true_p_WB, axis=0), axis=1).sum())

    @property
    def drift_percent(self) -> float:
        """How far off the end is, relative to the distance; NaN where nothing moved."""
        distance = self.distance_m
        return 100.0 * float(np.linalg.norm(self.p_WB[-1] - self.true_p_WB[-1])) / distance if distance else math.nan


def dead_reckoning(velocities: Sequence[Velocity], imu: Imu, truth: Truth) -> Track | None:
    """From the first valid velocity on, with the true position and attitude of that moment as the origin.

    After it the gyroscope alone says where B points, its bias taken as zero. None where there are not two velocities.
    """
    usable = _usable(velocities, imu, truth)
    if len(usable) < 2:
        return None
    t_ns = np.array([v.t_ns for v in usable], dtype=np.int64)
    v_B = np.array([v.v_B for v in usable])
    memory = InertialMemory((int(imu.t_ns[-1]) - int(imu.t_ns[0])) / NS_PER_S + 1.0)
    memory.append(imu.t_ns, imu.accel, imu.gyro)
    memory.integrate_to(int(imu.t_ns[-1]), np.zeros(3), np.zeros(3))
    R_LB, _, _ = memory.at(t_ns)
    R_WL = attitude_at(truth, int(t_ns[0])) @ R_LB[0].T
    v_W = np.einsum("ij,njk,nk->ni", R_WL, R_LB, v_B)
    true_p_WB = _true_positions(truth, t_ns)
    return Track(t_ns, true_p_WB[0] + _integral(t_ns, v_W), true_p_WB)


def attitude_at(truth: Truth, t_ns: int) -> F64:
    """True R_WB (3, 3), along the shortest rotation between the samples around ``t_ns``, within the truth's span."""
    k = int(np.clip(np.searchsorted(truth.t_ns, t_ns, side="right") - 1, 0, len(truth.t_ns) - 2))
    R_0, R_1 = (matrix_from_quaternion(truth.q_WB_xyzw[j]) for j in (k, k + 1))
    share = (t_ns - int(truth.t_ns[k])) / (int(truth.t_ns[k + 1]) - int(truth.t_ns[k]))
    R: F64 = R_0 @ exp(share * log(R_0.T @ R_1))
    return R


def _usable(velocities: Sequence[Velocity], imu: Imu, truth: Truth) -> list[Velocity]:
    first = next((i for i, v in enumerate(velocities) if v.valid), len(velocities))
    begin = max(int(imu.t_ns[0]), int(truth.t_ns[0]))
    end = min(int(imu.t_ns[-1]), int(truth.t_ns[-1]))
    return [v for v in velocities[first:] if begin <= v.t_ns <= end]


def _true_positions(truth: Truth, t_ns: I64) -> F64:
    """(n, 3), m; integrated from the true velocity where the truth holds no position."""
    if truth.p_WB is not None:
        return interpolated(truth.t_ns, truth.p_WB, t_ns)
    v_W = np.einsum("nij,nj->ni", matrix_from_quaternion(truth.q_WB_xyzw), truth.v_B)
    return interpolated(truth.t_ns, _integral(truth.t_ns, v_W), t_ns)


def _integral(t_ns: I64, v: F64) -> F64:
    """Of v (n, 3) from the first moment on, by trapezoids."""
    steps = 0.5 * (v[1:] + v[:-1]) * (np.diff(t_ns) / NS_PER_S)[:, None]
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
