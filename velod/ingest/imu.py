"""Checks of the IMU's samples."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numba import njit

from velod.alarms import Alarms
from velod.config import IngestSettings
from velod.events.columns import readonly
from velod.events.sae import NEVER
from velod.ingest.drops import count_drops
from velod.ingest.imu_units import ImuUnits
from velod.ingest.ordering import PacketOrder
from velod.types import F64, I64, NS_PER_S, ImuPacket

FROZEN, UNITS = "imu.frozen", "imu.units"
DROPS = ("imu.nan", "imu.backwards", FROZEN)
_NAN, _BACKWARDS, _FROZEN = range(3)


class ImuStream:
    """Drops what is not finite, not later than the sample before, or frozen; counts it as "imu.<cause>"."""

    def __init__(
        self, settings: IngestSettings, time_offset_s: float, counters: Counter[str], alarms: Alarms
    ) -> None:
        self.order: PacketOrder[ImuPacket] = PacketOrder(counters)
        self.t_ns = NEVER  # camera clock, of the last good sample
        self._last_ns = NEVER
        self._offset_ns = round(time_offset_s * NS_PER_S)
        self._max_frozen = settings.imu_frozen_samples
        self._identical = 1
        self._last_value = np.full(6, np.nan)
        self._units = ImuUnits()
        self._counters = counters
        self._alarms = alarms

    def take(self, packet: ImuPacket) -> list[tuple[I64, F64, F64]]:
        """What ``accept`` makes of the packet and of those that waited for it. Raises ClockRestart."""
        n = len(packet.sample_t_ns)
        if n == 0 or packet.accel.shape != (n, 3) or packet.gyro.shape != (n, 3):
            self._counters["packets.malformed"] += 1
            return []
        return [self.accept(p) for p in self.order.push(packet)]

    def accept(self, packet: ImuPacket) -> tuple[I64, F64, F64]:
        """Good samples of the packet: times on the camera's clock (t_imu - time_offset, Kalibr), accel, gyro."""
        n = len(packet.sample_t_ns)
        kept, dropped = np.empty(n, np.int64), np.zeros(len(DROPS), np.int64)
        n, self._last_ns, self._identical = _check(
            readonly(packet.sample_t_ns, np.int64), readonly(packet.accel, np.float64),
            readonly(packet.gyro, np.float64),
            self._max_frozen, self._last_ns, self._identical, self._last_value, kept, dropped,
        )  # fmt: skip
        count_drops(self._counters, DROPS, dropped)
        good = kept[:n]
        t_ns, accel, gyro = packet.sample_t_ns[good] - self._offset_ns, packet.accel[good], packet.gyro[good]
        if n:
            self.t_ns = int(t_ns[-1])
        self._doubt(t_ns, accel, gyro)
        return t_ns, accel, gyro

    def _doubt(self, t_ns: I64, accel: F64, gyro: F64) -> None:
        self._units.add(t_ns, accel, gyro)
        frozen = f"the IMU has repeated one sample {self._identical} times"
        self._alarms.say(UNITS, self._units.alarm)
        self._alarms.say(FROZEN, frozen if self._identical > self._max_frozen else "")


@njit(cache=True, nogil=True)
def _check(
    t_ns: I64,
    accel: F64,
    gyro: F64,
    max_frozen: int,
    last_ns: int,
    identical: int,
    last_value: F64,
    kept: I64,
    dropped: I64,
) -> tuple[int, int, int]:
    """Writes which samples are good to ``kept`` (n,), and counts the others in ``dropped`` by cause.

    ``last_value`` (6,) of the newest sample before, at ``last_ns``, which came ``identical`` times; it is renewed.
    Returns how many are good, and both of the newest sample now.
    """
    n = 0
    for i in range(t_ns.size):
        if not np.isfinite(accel[i].sum() + gyro[i].sum()):
            dropped[_NAN] += 1
            continue
        if t_ns[i] <= last_ns:
            dropped[_BACKWARDS] += 1
            continue
        last_ns = t_ns[i]
        same = True
        for j in range(3):
            same &= accel[i, j] == last_value[j] and gyro[i, j] == last_value[3 + j]
            last_value[j], last_value[3 + j] = accel[i, j], gyro[i, j]
        identical = identical + 1 if same else 1
        if identical > max_frozen:
            dropped[_FROZEN] += 1
            continue
        kept[n] = i
        n += 1
    return n, last_ns, identical
