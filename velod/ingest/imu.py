"""Checks of the IMU's samples."""

from __future__ import annotations

from collections import Counter

import numpy as np

from velod.config import IngestSettings
from velod.events.sae import NEVER
from velod.ingest.imu_units import ImuUnits
from velod.ingest.ordering import PacketOrder
from velod.types import F64, I64, NS_PER_S, ImuPacket

FROZEN, UNITS = "imu.frozen", "imu.units"


class ImuStream:
    """Drops what is not finite, not later than the sample before, or frozen; counts it as "imu.<cause>"."""

    def __init__(
        self, settings: IngestSettings, time_offset_s: float, counters: Counter[str], alarms: dict[str, str]
    ) -> None:
        self.order: PacketOrder[ImuPacket] = PacketOrder(counters)
        self.t_ns = 0  # camera clock, of the last good sample; 0: none yet
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
        value = np.hstack([packet.accel, packet.gyro])
        finite = np.isfinite(value.sum(axis=1))
        kept = [i for i in range(len(value)) if self._is_good(int(packet.sample_t_ns[i]), value[i], bool(finite[i]))]
        t_ns, accel, gyro = packet.sample_t_ns[kept] - self._offset_ns, packet.accel[kept], packet.gyro[kept]
        if kept:
            self.t_ns = int(t_ns[-1])
        self._doubt_units(t_ns, accel, gyro)
        return t_ns, accel, gyro

    def _doubt_units(self, t_ns: I64, accel: F64, gyro: F64) -> None:
        self._units.add(t_ns, accel, gyro)
        if self._units.alarm:
            self._alarms[UNITS] = self._units.alarm
        else:
            self._alarms.pop(UNITS, None)

    def _is_good(self, t_ns: int, value: F64, finite: bool) -> bool:
        if not finite:
            self._counters["imu.nan"] += 1
            return False
        if t_ns <= self._last_ns:
            self._counters["imu.backwards"] += 1
            return False
        self._last_ns = t_ns
        self._identical = self._identical + 1 if np.array_equal(value, self._last_value) else 1
        self._last_value = value
        if self._identical > self._max_frozen:
            self._counters[FROZEN] += 1
            self._alarms[FROZEN] = f"the IMU has repeated one sample {self._identical} times"
            return False
        self._alarms.pop(FROZEN, None)
        return True
