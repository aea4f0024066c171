"""While ingest is silent: the IMU straight from the sensor, so that the velocity goes on without it.

The optimizer takes IMU samples from ingest, which checks them and says how far the events have come. When ingest
dies or hangs, the same samples, checked in the same way, come from the sensor's own topic, and the last word of
ingest on the events stands. The stage sees one stream without a hole and without repeats, whoever sent it.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import replace
from typing import Final

import numpy as np

from velod.alarms import Alarms
from velod.config import IngestSettings
from velod.ingest.imu import ImuStream
from velod.ingest.ordering import CLOCK_RESTART_NS, ClockRestart
from velod.types import F64, I64, NS_PER_S, ImuPacket, ImuSamples
from velod.wire import WireError, decode, peek

SILENT_S: Final = 0.05
"""Without samples from ingest for so long it is not waited for: as long as the optimizer waits for a batch."""
KEPT: Final = 512
"""Packets of the sensor, half a second of single samples at 1 kHz: ingest may be behind when it dies."""
AGAIN_NS: Final = 100_000_000
"""So much of what was handed over already is looked at once more, for checks that go over several samples."""


class ImuBridge:
    """``from_ingest`` and ``due`` return what the stage is to be handed.

    ``now_s`` is any clock that does not go back.
    """

    def __init__(self, settings: IngestSettings, time_offset_s: float) -> None:
        """``time_offset_s``: t_imu = t_cam + time_offset_s, of the calibration."""
        self.counters: Counter[str] = Counter()
        self._settings, self._time_offset_s = settings, time_offset_s
        self._packets: deque[bytes] = deque(maxlen=KEPT)
        self._last: ImuSamples | None = None  # of ingest
        self._heard_s = 0.0  # when there were samples of ingest
        self._t_ns = -1  # newest sample handed over
        self._stream: ImuStream | None = None  # while bridging
        self._counted = False  # the bridge over this silence

    def keep(self, packet: bytes) -> None:
        """A packet of the sensor as it came; it is looked at when it is needed."""
        self._packets.append(packet)

    def from_ingest(self, samples: ImuSamples, now_s: float) -> list[ImuSamples]:
        """The message without what was handed over already; before it, what the sensor has sent meanwhile."""
        if 0 < samples.t_ns < self._t_ns - CLOCK_RESTART_NS:
            self._t_ns, self._stream = -1, None
            self._packets.clear()
        elif self._last is not None and samples.seq < self._last.seq:
            self._begin()  # another ingest, and the one before it may have died with samples
        before = []
        if len(samples.sample_t_ns):
            if self._stream is not None:
                before = self._from_sensor(int(samples.sample_t_ns[0]))
                self._stream = None
            self._heard_s = now_s
        self._last = samples
        return [*before, self._new(samples)]

    def due(self, now_s: float) -> list[ImuSamples]:
        """What the sensor has sent, while ingest is silent."""
        if self._last is None or not self._packets or now_s - self._heard_s < SILENT_S:
            return []
        self._begin()
        return self._from_sensor()

    def _begin(self) -> None:
        if self._stream is None:
            while self._packets and self._is_past(self._packets[0]):
                self._packets.popleft()
            self._stream = ImuStream(self._settings, self._time_offset_s, Counter(), Alarms())
            self._counted = False

    def _is_past(self, data: bytes) -> bool:
        """Whether a packet is of no use any more. Hundreds are kept: to check all would make a gap of its own."""
        try:
            t_ns = peek(data, "t_ns")
        except WireError:
            return False
        end_ns = self._t_ns + round(self._time_offset_s * NS_PER_S)
        return isinstance(t_ns, int) and end_ns - CLOCK_RESTART_NS < t_ns < end_ns - AGAIN_NS

    def _from_sensor(self, before_ns: int | None = None) -> list[ImuSamples]:
        """New samples of the packets kept, as if ingest had sent them without any word of events."""
        assert self._last is not None and self._stream is not None
        bridged = []
        while self._packets:
            for t_ns, accel, gyro in self._checked(self._packets.popleft()):
                n = len(t_ns) if before_ns is None else int(np.searchsorted(t_ns, before_ns))
                samples = replace(self._last, sample_t_ns=t_ns[:n], accel=accel[:n], gyro=gyro[:n])
                bridged.append(self._new(replace(samples, t_ns=_end(t_ns[:n], self._last.t_ns))))
        bridged = [samples for samples in bridged if len(samples.sample_t_ns)]
        if bridged:
            self.counters["bridge.begun"] += not self._counted
            self.counters["bridge.samples"] += sum(len(samples.sample_t_ns) for samples in bridged)
            self._counted = True
        return bridged

    def _checked(self, data: bytes) -> list[tuple[I64, F64, F64]]:
        assert self._stream is not None
        try:
            packet = decode(data, ImuPacket).message
            assert isinstance(packet, ImuPacket)
            return self._stream.take(packet)
        except WireError as e:
            self.counters[f"bridge.{e.reason}"] += 1  # an ingest that lives has counted it as its own
        except ClockRestart:
            self._packets.clear()  # ingest will say so
        return []

    def _new(self, samples: ImuSamples) -> ImuSamples:
        new = samples.sample_t_ns > self._t_ns
        if len(new):
            self._t_ns = max(self._t_ns, int(samples.sample_t_ns[-1]))
        if new.all():
            return samples
        columns = {name: getattr(samples, name)[new] for name in ("sample_t_ns", "accel", "gyro")}
        return replace(samples, **columns)


def _end(t_ns: I64, otherwise_ns: int) -> int:
    return int(t_ns[-1]) if len(t_ns) else otherwise_ns
