"""Zero velocity, from events and IMU together: nothing moves in the image, and the IMU only hears its own noise.

Either alone proves nothing: a steady flight leaves the IMU as quiet as rest does, and darkness the camera.
"""

from __future__ import annotations

import numpy as np

from velod.config import ImuSettings
from velod.optimizer.inertial import InertialMemory
from velod.types import F64, FlowBatch

QUIET_EVENTS = 5
"""A batch with fewer selected events than this shows nothing that moves."""
QUIET_NS = 200_000_000
"""Both must have been quiet for so long."""
SIGMAS = 4.0
"""Spread of the samples, in sigmas of the sensor's noise, up to which it is noise ..."""
GYRO_FLOOR, ACCEL_FLOOR = 0.005, 0.05
"""... and at least this much, rad/s and m/s^2: no IMU is as good as its data sheet."""
MAX_RATE = 0.02
"""Mean angular velocity at rest, less the bias, rad/s, beyond the bias's own uncertainty."""
MAX_SPECIFIC_FORCE_ERROR = 0.3
"""Of its mean against gravity, m/s^2: biases and scale."""


class Standstill:
    """Remembers since when the events have been quiet."""

    def __init__(self, imu: ImuSettings) -> None:
        self._imu = imu
        self._quiet_since_ns = -1

    def detected(self, flow: FlowBatch, memory: InertialMemory, b_w: F64) -> bool:
        """Whether the sensor rests at the end of this batch, the next after the one asked about before."""
        if flow.n_selected >= QUIET_EVENTS:
            self._quiet_since_ns = -1
            return False
        if self._quiet_since_ns < 0:
            self._quiet_since_ns = flow.t_ns
        start = flow.t_ns - QUIET_NS
        return self._quiet_since_ns <= start and self._imu_rests(memory, start, flow.t_ns, b_w)

    def _imu_rests(self, memory: InertialMemory, start_ns: int, end_ns: int, b_w: F64) -> bool:
        if not memory.covers(start_ns, end_ns):
            return False
        inside = slice(int(np.searchsorted(memory.t_ns, start_ns)), int(np.searchsorted(memory.t_ns, end_ns)))
        gyro, accel = memory.gyro[inside], memory.accel[inside]
        if len(gyro) < 10:
            return False
        rate_hz = len(gyro) / (QUIET_NS * 1e-9)
        gyro_noise, accel_noise = self._imu.gyro_noise * rate_hz**0.5, self._imu.accel_noise * rate_hz**0.5
        return bool(
            np.all(gyro.std(axis=0) < max(SIGMAS * gyro_noise, GYRO_FLOOR))
            and np.all(accel.std(axis=0) < max(SIGMAS * accel_noise, ACCEL_FLOOR))
            and np.linalg.norm(gyro.mean(axis=0) - b_w) < MAX_RATE + 3.0 * self._imu.gyro_bias_sigma
            and abs(np.linalg.norm(accel.mean(axis=0)) - self._imu.gravity) < MAX_SPECIFIC_FORCE_ERROR
        )
