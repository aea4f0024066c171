"""Which of several optimizers publishes: one leads, the others stand by and take over without a jump.

All follow the same inputs and make the same outputs, tick by tick of sensor time. Whoever stands by holds its own
back until it has heard the leader's of the same tick; when the leader is gone or falls silent, the first in line goes
on with the tick after the last one heard. No input or output and no clock here: calls in, turns to publish out;
``now_s`` is any clock that does not go backwards and does not stop while the process does.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

T = TypeVar("T")

PATIENCE_S = 0.05
"""The first in line takes over when it has held an output for so long; the second waits twice as long, and so on."""
ASLEEP_S = 0.6 * PATIENCE_S
"""A leader that has not looked for so long may have been taken for dead: it stands by ..."""
SETTLE_S = 0.02
"""... and goes on after so long without word of another leader."""
LINK_S = 1.0
"""After so long a sleep the links may have been given up ..."""
RELINK_S = 2.0
"""... and word of a new leader takes so long at the most."""
HELD = 512
"""Outputs; older ones are of no use to anybody."""
_NEVER = -(2**63)


@dataclass(frozen=True, slots=True)
class Turn(Generic[T]):
    """Publish ``output`` as number ``seq``."""

    seq: int
    output: T
    follows: bool = False
    """Another one has published what was before it, and may not have come to the end of that."""


@dataclass(slots=True)
class _Held(Generic[T]):
    t_ns: int
    since_s: float
    output: T


class Succession(Generic[T]):
    """The place of process ``me`` in the line. Alone from its start it leads at once, and nothing is ever held back.

    ``heard``, ``joined`` and ``left`` tell of the others; ``offer`` takes what this process has made, in order of
    sensor time; ``look`` is to be called every few milliseconds.
    """

    def __init__(self, me: str) -> None:
        self.counters: dict[str, int] = {}
        self.leads = False
        self._me = me
        self._others: set[str] = set()
        self._had_company = False
        self._leader = ""  # whom this process has heard last; empty: nobody, or gone
        self._held: deque[_Held[T]] = deque(maxlen=HELD)
        self._seq = 0  # of the next velocity
        self._published_t_ns = self._offered_t_ns = _NEVER  # by whomever; by the stage here
        self._looked_s = -1.0
        self._not_before_s = 0.0  # when it may take over at the earliest
        self._regain_s = math.inf  # when it leads again, if it hears of no other leader

    @property
    def role(self) -> str:
        """In a word, for health."""
        return "leads" if self.leads else "standby"

    def joined(self, worker: str) -> None:
        """Another one is there."""
        if worker != self._me:
            self._others.add(worker)
            self._had_company = True

    def left(self, worker: str, now_s: float) -> list[Turn[T]]:
        """Another one is gone; if it led, the first in line takes over at once."""
        self._others.discard(worker)
        if worker == self._leader:
            self._leader = ""
            if self._rank() == 0 and self._held and not self._overslept(now_s):
                return self._take_over()
        return self.look(now_s)

    def heard(self, worker: str, t_ns: int, seq: int, now_s: float) -> list[Turn[T]]:
        """Another one has published the velocity of ``t_ns``."""
        self._overslept(now_s)
        if self.leads and (t_ns, self._me) < (self._published_t_ns, worker):
            return []  # it is behind, or equal and of the later name: it will step back when it hears this one
        if self.leads:
            self._step_back("succession.yielded")
        self.joined(worker)
        self._regain_s = math.inf
        self._leader, self._published_t_ns, self._seq = worker, t_ns, seq + 1
        while self._held and self._held[0].t_ns <= t_ns:
            self._held.popleft()
        return []

    def offer(self, t_ns: int, output: T, now_s: float) -> list[Turn[T]]:
        """This process has made the output of ``t_ns``."""
        self._overslept(now_s)
        if t_ns <= self._offered_t_ns:  # the sensor's clock was set anew
            self._held.clear()
            self._published_t_ns = _NEVER
        self._offered_t_ns = t_ns
        if t_ns > self._published_t_ns:
            self._held.append(_Held(t_ns, now_s, output))
        return self.look(now_s)

    def look(self, now_s: float) -> list[Turn[T]]:
        """What is to be published now."""
        self._overslept(now_s)
        if not self._held:
            return []
        if self.leads:
            return self._release()
        waited_s = now_s - self._held[0].since_s
        alone = not self._had_company
        its_turn = waited_s >= PATIENCE_S * (1 + self._rank()) and now_s >= self._not_before_s
        return self._take_over() if alone or its_turn or now_s >= self._regain_s else []

    def _rank(self) -> int:
        """How many come before this one, the leader that is to be replaced aside."""
        return sum(other < self._me for other in self._others if other != self._leader)

    def _overslept(self, now_s: float) -> bool:
        """Whether this process did not run for a while; a leader then stands by first."""
        slept_s = now_s - self._looked_s if self._looked_s >= 0.0 else 0.0
        self._looked_s = now_s
        if slept_s <= ASLEEP_S or not self._had_company:
            return False
        if self.leads:
            self._step_back("succession.slept")
            self._regain_s = now_s + SETTLE_S
        if slept_s > LINK_S:
            self._not_before_s, self._regain_s = now_s + RELINK_S, math.inf
        # What others made of the meantime is waiting to be heard.
        for held in self._held:
            held.since_s = now_s
        return True

    def _step_back(self, why: str) -> None:
        self.leads = False
        self._leader = ""
        self.counters[why] = self.counters.get(why, 0) + 1

    def _take_over(self) -> list[Turn[T]]:
        self.leads, self._leader, self._regain_s = True, "", math.inf
        self.counters["succession.led"] = self.counters.get("succession.led", 0) + 1
        first, *others = self._release()
        return [replace(first, follows=True), *others]

    def _release(self) -> list[Turn[T]]:
        turns = [Turn(self._seq + i, held.output) for i, held in enumerate(self._held)]
        self._published_t_ns = self._held[-1].t_ns
        self._seq += len(turns)
        self._held.clear()
        return turns
