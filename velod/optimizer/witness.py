"""An estimate from before flow and IMU began to disagree, which the IMU alone carries on: a witness.

Batches that tell of another motion than the IMU win in the end, for more and more of them come. That is right after
a blow that the accelerometer did not follow, and wrong where something that moves by itself fills the view. Which it
was cannot be told. So what the estimate has moved away from the witness is part of its uncertainty, until both agree
again or the witness is too old: what is seen for seconds are the surroundings.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from velod.optimizer.head import Head
from velod.optimizer.small import squared_distance
from velod.types import F64

LOOK_BACK_NS = 400_000_000
"""A disagreement may have begun so long before it is noticed ..."""
OLDEST_NS = 2_000_000_000
"""... and is held against the estimate for so long."""
AGREES = 14.16
"""Squared distance, in three dimensions, of what noise explains: 3 sigma, 99.7 %."""


class Witness:
    """``head`` is the witness, None where there is no need of one."""

    def __init__(self) -> None:
        self.head: Head | None = None
        self.doubt_L: F64 = np.zeros((3, 3))  # covariance for what noise does not explain, (m/s)^2
        self._offset = 0.0  # of the estimate from the witness, m/s, where noise does not explain that
        self._before: deque[Head] = deque()

    def watch(self, newest: Head, *, suspicious: bool) -> None:
        """After every batch; ``suspicious``: flow and IMU disagree."""
        if self.head is not None and newest.t_ns - self.head.t_ns > OLDEST_NS:
            self.dismiss()
        if not suspicious and self.head is None:
            self._before.append(newest)
            while self._before[0].t_ns < newest.t_ns - LOOK_BACK_NS:
                self._before.popleft()
        elif self.head is None and self._before:
            self.head = self._before[0]

    def compare(self, newest: Head, v_B: F64, cov: F64, *, suspicious: bool) -> None:
        """The witness's velocity (3,) with ``cov`` (3, 3), carried to the newest estimate."""
        offset = newest.v_B - v_B
        explained = squared_distance(offset, cov + newest.cov[:3, :3]) < AGREES
        if explained and not suspicious:
            self.dismiss()
        elif explained:
            self._trust()
        else:
            # where the witness is right
            self.doubt_L = newest.R_LB @ (np.outer(offset, offset) + cov) @ newest.R_LB.T
            self._offset = float(np.linalg.norm(offset))

    def dismiss(self) -> None:
        """There is no disagreement any more."""
        self.head = None
        self._before.clear()
        self._trust()

    def _trust(self) -> None:
        """Noise explains how far the estimate is from the witness."""
        self.doubt_L, self._offset = np.zeros((3, 3)), 0.0

    @property
    def testimony(self) -> str:
        """In words; empty where there is nothing to say."""
        if self._offset == 0.0:
            return ""
        return f"flow and IMU disagree by {self._offset:.2f} m/s: does the scene move by itself?"
