"""The paper's numbers (Lu et al., RSS 2024, arXiv 2311.18189), for the tables to stand beside."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PaperRow:
    """What the paper reports of one of its sequences."""

    name: str  # the paper's
    table: str  # where the errors are
    speed_mps: float  # Table I
    rate_rad_s: float  # Table I
    ours_mps: float  # average AVE
    imu_mps: float
    benosman_mps: float
    others_mps: tuple[float, float, float]  # VINS-Fusion, PR-VINS, USLAM; NaN: failed
    real: bool = False  # recorded, where ours is simulated: only the kind of motion is the same


PAPER = {
    "corridor-1": PaperRow("Synthetic_1", "Table II", 5.68, 0.66, 0.09, 2.67, 10.78, (0.48, 1.31, math.nan)),
    "corridor-2": PaperRow("Synthetic_2", "Table II", 11.0, 1.45, 0.16, 5.73, 13.57, (0.87, 1.33, 23.29)),
    "corridor-3": PaperRow("Synthetic_3", "Table II", 18.9, 2.50, 0.19, 7.83, 13.14, (19.80, 2.99, 75.33)),
    "boxes-4": PaperRow("Synthetic_4", "Table II", 2.77, 2.05, 0.06, 0.54, 6.71, (0.14, 0.27, 19.27)),
    "boxes-5": PaperRow("Synthetic_5", "Table II", 3.19, 3.11, 0.08, 0.63, 7.75, (0.23, 0.37, math.nan)),
    "spin-1": PaperRow("Real_1", "Table III", 2.17, 4.82, 0.72, 1.39, 4.43, (2.30, 3.86, 1.79), real=True),
    "spin-2": PaperRow("Real_2", "Table III", 4.94, 13.30, 1.83, 9.21, 4.89, (8.43, 7.62, 7.48), real=True),
    "spin-3": PaperRow("Real_3", "Table III", 4.84, 11.26, 1.65, 8.89, 5.97, (7.62, 7.46, 7.49), real=True),
}
"""By velod's name of the sequence with that motion."""

TABLE_IV_MS = {"preprocessing": 3.0, "flow and depth": 10.0, "back end": 10.0, "overall": 23.0}
"""Computation time per batch (Table IV; C++, Core i7-13700K)."""
