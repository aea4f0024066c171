"""Load shedding: what ingest may take on, from how late its workers and it itself are.

Late means waiting: a batch that is not finished, a packet that has not been looked at. What is done first costs
nearly nothing: batches are no more than outputs. While something is later than a target, less is taken on: fewer
events, then fewer batches or packets, never old ones. No input or output and no clock here; ``now_s`` is any clock
that does not go backwards.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from velod.ingest.budget import BAND_ROWS, LEAST_ROWS, Budget

FALL = 0.8
"""A share is multiplied by this while something is late, once in the time that is late."""
GRACE_S = 0.25
"""It falls only after so long without a moment in time: a process that starts beside velod is no overload."""
EVENT_GRACE_S = 0.05
"""Likewise event by event, where latency comes first."""
RISE_PER_S = 0.5
"""A share grows by so much in a second while nothing is."""
CALM = 0.5
"""Shares grow while nothing is later than this part of the target."""
LEAST_SELECTION = 0.1
"""With fewer events a batch costs hardly less, and says little: then there are fewer batches."""
STANDING_S = 0.025
"""Where every batch has to wait for so long, for as long as the grace, a queue stands that nothing drains ..."""
STANDING_SELECTION = 0.5
"""... and it costs latency alone: so much less is selected at the most until it is gone."""
HURRIED_S = 0.01
"""A batch that is not finished after so long (a worker takes half of that) shows that cores are short ..."""
SPACED_FOR_S = 10.0
"""... and batches are no more than outputs until there has been no such batch for so long."""
LEAST_BATCHES = 0.1
NO_BATCH = 2.0
"""While a batch is later than this many targets, no further one is made."""
FEWER_ROWS = 1.5
"""While a packet waits for more than this many targets, fewer rows are looked at: fewer batches were not enough."""
NO_PACKET, PACKETS_AGAIN = 3.0, 2.0
"""Once an event packet has waited for this many targets, all are dropped until one has waited for so few. That is
still late for rows, or a stream that is far too much would only ever lose packets, which are holes in time."""
MAX_WAITING = 8
"""Batches that may wait for a worker at once; each holds the surfaces of both cameras."""
ALARM_BELOW = 0.95
_PERIOD_S = 1.0


@dataclass(slots=True)
class Share:
    """A share of the load that falls quickly while there is delay, and rises slowly while there is none."""

    target_s: float
    least: float
    grace_s: float = GRACE_S
    standing_s: float = math.inf
    value: float = 1.0
    _last_s: float = math.inf
    _late_s: float = math.inf  # since when there has been delay
    _standing_since_s: float = math.inf  # since when a queue has stood
    _patience_s: float = -math.inf  # no further fall before: the last one has not had its effect

    def note(self, delay_s: float, now_s: float) -> None:
        """What is waiting now has waited for ``delay_s``."""
        elapsed_s = max(0.0, now_s - self._last_s)
        self._last_s = now_s
        self._late_s = min(self._late_s, now_s) if delay_s > self.target_s else math.inf
        self._standing_since_s = min(self._standing_since_s, now_s) if delay_s > self.standing_s else math.inf
        if delay_s > self.target_s:
            self._fall(self._late_s, self.least, self.target_s)
        elif delay_s > self.standing_s:
            self._fall(self._standing_since_s, STANDING_SELECTION, self.grace_s)
        elif delay_s < CALM * min(self.target_s, self.standing_s):
            self.value = min(1.0, self.value + RISE_PER_S * min(elapsed_s, _PERIOD_S))

    def _fall(self, since_s: float, least: float, pause_s: float) -> None:
        if self.value > least and self._last_s >= max(self._patience_s, since_s + self.grace_s):
            self.value = max(least, self.value * FALL)
            self._patience_s = self._last_s + pause_s


@dataclass(slots=True)
class LoadShedder:
    """Ingest's budget. ``target_s`` 0: nothing is ever shed.

    ``event_target_s``: of packets and slices, where events are selected one by one; 0: they are not.
    """

    target_s: float
    event_target_s: float = 0.0
    counters: dict[str, int] = field(default_factory=dict)
    _selection: Share = field(init=False)
    _slices: Share = field(init=False)
    _batches: Share = field(init=False)
    _rows: Share = field(init=False)
    _room: int = MAX_WAITING
    _spaced: bool = False
    _hurried_s: float = -math.inf  # when a batch last took too long
    _cuts: bool = True
    _dropping: bool = False
    _shed: int = 0  # batches, when the last period ended
    _made: int = 0  # batches of this period, and how much of the quota they had
    _selected: float = 0.0
    _packets: int = 0  # of this period, and how much of them was looked at
    _looked_at: float = 0.0
    _used: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        self._selection = Share(self.target_s, LEAST_SELECTION, standing_s=STANDING_S)
        self._slices = Share(self.event_target_s, LEAST_SELECTION, EVENT_GRACE_S)
        by_event = self.event_target_s > 0.0
        grace_s = EVENT_GRACE_S if by_event else GRACE_S
        self._batches = Share(self._packet_s, LEAST_BATCHES, grace_s)
        # Event by event a packet is late at once, and rows are what most of the work goes with.
        targets = 1.0 if by_event else FEWER_ROWS
        self._rows = Share(targets * self._packet_s, LEAST_ROWS / BAND_ROWS, grace_s)

    @property
    def _packet_s(self) -> float:
        return self.event_target_s or self.target_s

    def note_workers(self, delay_s: float, waiting: int, now_s: float) -> None:
        """What a new batch has to wait for has been there for ``delay_s``; ``waiting`` batches have not been sent."""
        self._selection.note(delay_s, now_s)
        self._room = 0 if delay_s > NO_BATCH * self.target_s else max(0, MAX_WAITING - waiting)

    def note_unanswered(self, delay_s: float, now_s: float) -> None:
        """The oldest batch that no worker has finished has been there for ``delay_s``."""
        if self.target_s and delay_s > HURRIED_S:
            self._hurried_s = now_s
        self._spaced = now_s < self._hurried_s + SPACED_FOR_S

    def note_slices(self, delay_s: float, waiting: int, now_s: float) -> None:
        """Event by event: as ``note_workers``, of a new slice. While one waits, what is selected joins the next."""
        self._slices.note(delay_s, now_s)
        self._cuts = waiting == 0

    def takes_packet(self, waited_s: float, now_s: float) -> bool:
        """Whether an event packet that has waited for so long is to be looked at; else it is counted and dropped."""
        if not self.target_s:
            return True
        self._batches.note(waited_s, now_s)
        self._rows.note(waited_s, now_s)
        self._dropping = waited_s > (PACKETS_AGAIN if self._dropping else NO_PACKET) * self._packet_s
        if self._dropping:
            self.counters["shed.packets"] = self.counters.get("shed.packets", 0) + 1
        self._packets += 1
        self._looked_at += 0.0 if self._dropping else self._rows.value
        return not self._dropping

    def budget(self) -> Budget:
        """What may be taken on now."""
        if not self.target_s:
            return Budget()
        return Budget(self._share, self._rows.value, self._batches.value, self._room, self._cuts, self._spaced)

    @property
    def _share(self) -> float:
        return min(self._selection.value, self._slices.value)

    def note_batch(self) -> None:
        """A batch was made within the budget."""
        self._made += 1
        self._selected += self._share if self.target_s else 1.0

    def end_period(self, counters: Mapping[str, int]) -> None:
        """A period of health ends, with these counters of ingest; ``gauges`` and ``alarms`` now speak of it."""
        shed = counters.get("shed.batches", 0)
        batches, self._shed = self._made + shed - self._shed, shed
        self._used = (
            self._selected / batches if batches else 1.0,
            self._looked_at / self._packets if self._packets else 1.0,
        )
        self._made, self._selected, self._packets, self._looked_at = 0, 0.0, 0, 0.0

    def gauges(self) -> dict[str, float]:
        """Shares of the period: of the selection (batches that were not made count 0), and of the events; and whether
        batches are no more than outputs.
        """
        return {
            "share.selection": self._used[0],
            "share.events": self._used[1],
            "batches.spaced": float(self._spaced),
        }

    def alarms(self) -> dict[str, str]:
        """What was shed in the period."""
        selection, rows = self._used
        out = {}
        if selection < ALARM_BELOW:
            out["load.selection"] = f"the workers or ingest cannot keep up: {selection:.0%} of the quota is used"
        if rows < ALARM_BELOW:
            out["load.events"] = f"ingest cannot keep up: {rows:.0%} of the events are looked at"
        return out
