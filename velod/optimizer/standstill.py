"""Zero velocity, from events and IMU together: nothing moves in the image, and the IMU only hears its own noise.

Either alone proves nothing: a steady flight leaves the IMU as quiet as rest does, and darkness the camera. Both prove
nothing in a steady flight whose lens is covered: so what is known of the velocity when the events cease must not
contradict rest, and who turns without seeing anything is in the dark until events come back.
"""

from __future__ import annotations

import numpy as np

from velod.config import ImuSettings
from velod.events.sae import NEVER
from velod.optimizer.bias_prior import IMPLAUSIBLE
from velod.optimizer.inertial import InertialMemory
from velod.types import F64, FlowBatch

QUIET_EVENTS = 5
"""A batch with fewer selected events than this shows nothing that moves."""
QUIET_NS = 200_000_000
"""Both must have been quiet for so long."""
MAX_EVENT_HZ = 2.0
"""Events per pixel and second beyond which noise cannot be told from slow motion."""
EVENTS_PER_PX = 0.05
"""Events per pixel of the sensor that one pixel of motion causes at the least: a few edges, some too faint."""
STILL_SIGMA = 0.0005
"""Of a velocity observed as zero at the end of one batch without an event, m/s."""
SIGMAS = 4.0
"""Spread of the samples, in sigmas of the sensor's noise, up to which it is noise ..."""
GYRO_FLOOR, ACCEL_FLOOR = 0.005, 0.05
"""... and at least this much, rad/s and m/s^2: no IMU is as good as its data sheet."""
MAX_RATE = 0.02
"""Mean angular velocity at rest, less the bias, rad/s, beyond the bias's own uncertainty."""
MAX_SPECIFIC_FORCE_ERROR = 0.3
"""Of its mean against gravity, m/s^2, beyond the bias's own uncertainty: scale, and local gravity."""

TURNING = 0.2
"""rad/s over QUIET_NS, which moves the image by several pixels: whoever sees nothing then is in the dark."""
SLOW, SLOW_SIGMAS = 0.05, 3.0
"""What is known of the velocity contradicts rest beyond SLOW m/s + SLOW_SIGMAS of its sigmas ..."""
DECIDED_NS = 500_000_000
"""... and if it still does so long after the events ceased, it is dark."""


class Standstill:
    """Remembers since when the events have been quiet. ``dark``: they are, though the sensor moves."""

    def __init__(self, imu: ImuSettings, pixels: int) -> None:
        """``pixels``: of the left sensor."""
        self.imu, self._pixels = imu, pixels
        self._t_ns = NEVER
        self._event_hz = 0.0  # per pixel, in the newest batch
        self._quiet_since_ns = NEVER
        self.dark = False
        self._rests = False  # at the end of the newest batch

    @property
    def unseen_px_s(self) -> float:
        """Image motion of which nothing is selected and that would cause no more events than the newest batch has."""
        return self._event_hz / EVENTS_PER_PX

    def sigma(self, m_per_px: float) -> float:
        """How far from zero the velocity may be at the end of the newest batch, m/s; ``m_per_px``: depth over f."""
        return max(STILL_SIGMA, self.unseen_px_s * m_per_px)

    def detected(self, flow: FlowBatch, memory: InertialMemory, b_w: F64, predicted: tuple[F64, F64] | None) -> bool:
        """Whether the sensor rests at the end of this batch, the next after the one asked about before.

        ``predicted``: v_B (3,) and its covariance (3, 3) there, as far as anything is known of them.
        """
        self._rests = self._detected(flow, memory, b_w, predicted)
        return self._rests

    def goes_on(self, memory: InertialMemory, t_ns: int, b_w: F64) -> bool:
        """Whether there was rest at the end of the newest batch and the IMU has been quiet up to ``t_ns``."""
        return self._rests and self._imu_rests(memory, t_ns - QUIET_NS, t_ns, b_w)

    def _detected(self, flow: FlowBatch, memory: InertialMemory, b_w: F64, predicted: tuple[F64, F64] | None) -> bool:
        self._note_events(flow)
        if flow.n_selected >= QUIET_EVENTS or self._event_hz > MAX_EVENT_HZ:
            self._quiet_since_ns = NEVER
            self.dark = False
            return False
        if self._quiet_since_ns == NEVER:
            self._quiet_since_ns = flow.t_ns
        start = flow.t_ns - QUIET_NS
        if self._quiet_since_ns > start or not memory.covers(start, flow.t_ns):
            return False
        rests = self._imu_rests(memory, start, flow.t_ns, b_w)
        moves = predicted is not None and contradicts_rest(*predicted)
        decided = flow.t_ns - self._quiet_since_ns >= DECIDED_NS
        self.dark |= (rests and moves and decided) or self._turns(memory, start, flow.t_ns, b_w)
        return rests and not moves and not self.dark

    def _note_events(self, flow: FlowBatch) -> None:
        span_s = (flow.t_ns - self._t_ns) * 1e-9
        known = self._t_ns != NEVER and span_s > 0.0 and flow.n_events >= 0
        self._event_hz = flow.n_events / self._pixels / span_s if known else MAX_EVENT_HZ
        self._t_ns = flow.t_ns

    def _turns(self, memory: InertialMemory, start_ns: int, end_ns: int, b_w: F64) -> bool:
        gyro = memory.gyro[memory.between(start_ns, end_ns)]
        return len(gyro) > 0 and float(np.linalg.norm(gyro.mean(axis=0) - b_w)) > TURNING

    def _imu_rests(self, memory: InertialMemory, start_ns: int, end_ns: int, b_w: F64) -> bool:
        inside = memory.between(start_ns, end_ns)
        gyro, accel = memory.gyro[inside], memory.accel[inside]
        if len(gyro) < 10:
            return False
        rate_hz = len(gyro) / (QUIET_NS * 1e-9)
        gyro_noise, accel_noise = self.imu.gyro_noise * rate_hz**0.5, self.imu.accel_noise * rate_hz**0.5
        return bool(
            np.all(gyro.std(axis=0) < max(SIGMAS * gyro_noise, GYRO_FLOOR))
            and np.all(accel.std(axis=0) < max(SIGMAS * accel_noise, ACCEL_FLOOR))
            and np.linalg.norm(gyro.mean(axis=0) - b_w) < MAX_RATE + IMPLAUSIBLE * self.imu.gyro_bias_sigma
            and abs(np.linalg.norm(accel.mean(axis=0)) - self.imu.gravity)
            < MAX_SPECIFIC_FORCE_ERROR + IMPLAUSIBLE * self.imu.accel_bias_sigma
        )


def contradicts_rest(v_B: F64, cov: F64) -> bool:
    """Whether a velocity (3,) with covariance (3, 3) is known not to be zero."""
    speed = float(np.linalg.norm(v_B))
    # the sigma along v_B
    sigma = float(np.sqrt(v_B @ cov @ v_B)) / speed if speed > 0.0 else 0.0
    return speed > SLOW + SLOW_SIGMAS * sigma
