"""How many events find their match in the right camera: whether the two cameras see the same at all."""

from __future__ import annotations

from velod.events.sae import NEVER
from velod.types import DepthBatch

LEAST_SHARE = 0.1
"""Swapped or mirrored cameras, or clocks 0.1 s apart, give depths to 3 or 4 % of the events by chance, sound ones to
58 to 90 %. Below this a third of the depths and more would be such matches."""
ENOUGH = 50
"""Selected events of a batch from which on its share means something."""
PROBATION_NS = 800_000_000
"""A right camera that is late by 60 to 100 ms finds its own past on the surfaces, 30 to 70 % of the events at a wrong
disparity, for 0.2 to 0.7 s between batches of which it finds nothing: so long an estimate waits to be valid."""
DISAGREEING_NS = 30_000_000
"""It finds nothing for as long as it is late; sound cameras may have few depths of the first noisy events too."""
_NEWEST = 0.05
"""Weight of the newest batch in the mean: a quarter of a second at the usual rate."""


def cameras_disagree(depth: DepthBatch) -> bool:
    """Whether so few events of a batch have a depth that those few may well be wrong matches."""
    return depth.n_selected >= ENOUGH and len(depth.index) < LEAST_SHARE * depth.n_selected


class Probation:
    """Of cameras that did not see the same for a moment: what they match soon after may be wrong."""

    def __init__(self) -> None:
        self._first_ns = NEVER  # batch of those in a row of which the cameras disagree
        self._since_ns = NEVER

    def note(self, t_ns: int, *, disagree: bool) -> None:
        """A batch that ended at ``t_ns``, of which the cameras ``disagree``."""
        if not disagree:
            self._first_ns = NEVER
        elif self._first_ns == NEVER:
            self._first_ns = t_ns
        elif t_ns - self._first_ns >= DISAGREEING_NS:
            self._since_ns = t_ns

    def lasts(self, t_ns: int) -> bool:
        """Whether it is not over at ``t_ns``."""
        return t_ns - self._since_ns < PROBATION_NS


class DepthShare:
    """The share over the last batches."""

    def __init__(self) -> None:
        self.mean = 1.0

    def add(self, depth: DepthBatch) -> None:
        """A batch; with too few events it says nothing."""
        if depth.n_selected >= ENOUGH:
            self.mean += _NEWEST * (len(depth.index) / depth.n_selected - self.mean)

    @property
    def alarm(self) -> str:
        """What is wrong, or nothing."""
        if self.mean >= LEAST_SHARE:
            return ""
        return (
            f"{100.0 * self.mean:.0f} % of the events find their match in the right camera: is one covered, are they "
            "swapped, mirrored, or their clocks far apart?"
        )
