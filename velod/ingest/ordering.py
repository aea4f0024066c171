"""The order of one publisher's packets: duplicates, gaps, late ones, restarts."""

from __future__ import annotations

from collections import Counter, OrderedDict
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from velod.types import EventPacket, ImuPacket

P = TypeVar("P", EventPacket, ImuPacket)

MAX_HELD = 4
"""Packets that wait for a missing one."""

MAX_WAIT_NS = 20_000_000
"""Sensor time that packets wait for a missing one."""

CLOCK_RESTART_NS = 10_000_000_000
"""A jump back in time by more than this means that the sensor's clock was restarted."""

REMEMBERED = 256
"""Packets that are recognised as duplicates."""


class ClockRestart(Exception):
    """The packet belongs to a new epoch of the sensor's clock: everything kept so far is void."""


@dataclass(slots=True)
class PacketOrder(Generic[P]):
    """Puts packets in order of ``seq``; counts into ``counters`` as "packets.<what>"."""

    counters: Counter[str]
    _next_seq: int | None = None
    _t_ns: int = 0
    _held: dict[int, P] = field(default_factory=dict)
    _seen: OrderedDict[int, int] = field(default_factory=OrderedDict)

    def push(self, packet: P) -> list[P]:
        """The packets that are now in order. Raises ClockRestart, and then has kept nothing."""
        if self._next_seq is None:
            return self._release(packet)
        if self._seen.get(packet.seq) == packet.t_ns:
            self.counters["packets.duplicate"] += 1
            return []
        if self._t_ns - packet.t_ns > CLOCK_RESTART_NS:
            raise ClockRestart
        if packet.seq < self._next_seq:
            return self._lower_seq(packet)
        self._remember(packet)
        self._held[packet.seq] = packet
        released = self._in_order()
        while self._held and self._waited_enough():
            # The missing ones are given up.
            first = min(self._held)
            self.counters["packets.gap"] += first - self._next_seq
            self._next_seq = first
            released += self._in_order()
        return released

    def _lower_seq(self, packet: P) -> list[P]:
        if packet.t_ns > self._t_ns:
            # Numbers start again while time goes on: the publisher was restarted.
            self.counters["packets.restart"] += 1
            released = [self._held[seq] for seq in sorted(self._held)]
            self._held.clear()
            self._seen.clear()
            return released + self._release(packet)
        if packet.seq in self._seen:
            # A number used before, at another and earlier time: publisher and clock were restarted.
            raise ClockRestart
        self.counters["packets.late"] += 1
        return []

    def _waited_enough(self) -> bool:
        newest = max(p.t_ns for p in self._held.values())
        return len(self._held) > MAX_HELD or newest - self._t_ns > MAX_WAIT_NS

    def _in_order(self) -> list[P]:
        released: list[P] = []
        while self._next_seq in self._held:
            released += self._release(self._held.pop(self._next_seq))
        return released

    def _release(self, packet: P) -> list[P]:
        self._remember(packet)
        self._next_seq = packet.seq + 1
        self._t_ns = max(self._t_ns, packet.t_ns)
        return [packet]

    def _remember(self, packet: P) -> None:
        self._seen[packet.seq] = packet.t_ns
        while len(self._seen) > REMEMBERED:
            self._seen.popitem(last=False)
