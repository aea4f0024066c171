"""The newest estimate, from which the IMU carries on."""

from __future__ import annotations

import math
from dataclasses import dataclass

from velod.types import F64


@dataclass(frozen=True, slots=True)
class Head:
    """The estimate at the end of the newest batch: [v_B, b_a, b_w, g_L] with covariance (12, 12)."""

    t_ns: int
    v_B: F64
    b_a: F64
    b_w: F64
    g_L: F64
    R_LB: F64
    cov: F64
    common: F64  # (3,) common errors of the flows, flow_equation.COMMON
    common_cov: F64  # (3, 3)
    e_L: F64  # (3,) e of v_B = R_BL (s_L + e), m/s

    def e_at(self, t_ns: int) -> F64:
        """e (3,) at ``t_ns``, from here on along the slope of gravity."""
        return self.e_L - (t_ns - self.t_ns) * 1e-9 * self.g_L

    @property
    def gravity_direction_sigma(self) -> float:
        """Standard deviation of the direction of g_L, rad."""
        g, cov = self.g_L, self.cov[9:, 9:]
        squared_norm = float(g @ g)
        # the trace of the covariance across g
        across = float(cov[0, 0] + cov[1, 1] + cov[2, 2] - g @ cov @ g / squared_norm)
        return math.sqrt(max(across, 0.0) / squared_norm)
