"""Whether the flows and the IMU tell of the same motion: innovations of the batches, averaged over a moment.

A covariance knows of noise only. A gyroscope that has died, a shock beyond the accelerometer's range, a clock that
jumped or a wrong T_cam_imu are seen here: the batches' own velocities lie off the predicted ones, again and again.
"""

from __future__ import annotations

BATCHES = 8
"""Batches over which innovations are averaged."""
USUAL = 5.0
"""Of the average, per degree of freedom: beyond what any of the sound recordings shows that were tried (2.9)."""
HOPELESS = 10.0
"""So much, over ``BATCHES`` in a row: nothing of the estimate can be saved."""
PROBATION = 2 * BATCHES
"""Batches that must agree again after that."""
MOST = 300.0
"""One batch says no more than this."""
LASTING, LASTING_USUAL, LASTING_MOST = 24, 2.5, 10.0
"""The same over more batches, of which none says much: a scene that sets out slowly. Sound recordings reach 1.65."""


class Consistency:
    """Average of the squared Mahalanobis distances of the last batches from their prediction, over 3."""

    def __init__(self) -> None:
        self._average = self._lasting = 1.0
        self._hopeless = 0
        self._on_probation = 0

    def note(self, squared_distance: float) -> None:
        """One batch, with three degrees of freedom."""
        self._average += (min(squared_distance / 3.0, MOST) - self._average) / BATCHES
        self._lasting += (min(squared_distance / 3.0, LASTING_MOST) - self._lasting) / LASTING
        self._hopeless = self._hopeless + 1 if self._average > HOPELESS else 0
        self._on_probation = max(0, self._on_probation - 1)

    @property
    def factor(self) -> float:
        """On the covariance: what disagrees is a bias, which adds up where noise averages out."""
        return max(1.0, self._average / USUAL) ** 2

    @property
    def disagreement(self) -> str:
        """In words; empty where flow and IMU agree."""
        if self._average > USUAL or self._lasting > LASTING_USUAL:
            times = max(self._average, self._lasting) ** 0.5
            return f"flow and IMU disagree: {times:.1f} times what their noise explains"
        return "flow and IMU disagreed a moment ago" if self._on_probation else ""

    @property
    def hopeless(self) -> bool:
        """Whether it is better to start anew."""
        return self._hopeless >= BATCHES

    @property
    def on_probation(self) -> bool:
        """Whether a new start has yet to show that the two agree."""
        return self._on_probation > 0

    def start_anew(self) -> None:
        """Nothing that was said before is held against the next batches, but they are on probation."""
        self._average = self._lasting = 1.0
        self._hopeless, self._on_probation = 0, PROBATION
