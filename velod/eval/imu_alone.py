"""How far the IMU alone gets, from a true start: over time, and over many noises."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from velod.config import Settings
from velod.eval.baselines import integrate_imu
from velod.eval.metrics import truth_at
from velod.io.model import Imu, Truth
from velod.types import F64, NS_PER_S


@dataclass(frozen=True, slots=True)
class ImuAlone:
    """AVE of the IMU's integration up to several moments, for several noises."""

    seconds: tuple[float, ...]  # (k,) since the start
    ave_mps: F64  # (noises, k)

    def quantiles(self, shares: Sequence[float]) -> F64:
        """Over the noises, (len(shares), k)."""
        found: F64 = np.quantile(self.ave_mps, shares, axis=0)
        return found

    def share_below(self, ave_mps: float) -> F64:
        """The share of the noises with a smaller AVE, (k,)."""
        share: F64 = np.mean(self.ave_mps < ave_mps, axis=0)
        return share


def imu_alone(imus: Sequence[Imu], truth: Truth, settings: Settings, seconds: Sequence[float]) -> ImuAlone:
    """Integrate every IMU from the true velocity and attitude; ``truth`` and IMUs reach over all of ``seconds``."""
    rows = []
    for imu in imus:
        velocities = integrate_imu(imu, truth, settings)
        t_ns = np.array([v.t_ns for v in velocities], dtype=np.int64)
        error = np.linalg.norm(np.array([v.v_B for v in velocities]) - truth_at(truth, t_ns), axis=1)
        since_s = (t_ns - int(imu.t_ns[0])) / NS_PER_S
        rows.append([float(error[since_s <= limit].mean()) for limit in seconds])
    return ImuAlone(tuple(seconds), np.array(rows).reshape(len(imus), len(seconds)))
