"""The optimizer as a stage: joins flow, depth and IMU in sensor-time order and puts out velocities at a fixed rate.

What comes out depends on sensor time alone, not on the order or moment of arrival: batches are taken in by their end
time, and the velocity at tick tau is made once every batch that ended by tau has been taken in. Only where a batch
stays away for longer than ``max_wait_ms`` of sensor time is a velocity made without it; it is then taken in late.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from velod.config import Settings
from velod.events.sae import NEVER
from velod.events.sensor_size import for_sensor
from velod.geometry.calibration import Calibration
from velod.optimizer.attitude import Attitude
from velod.optimizer.calibration_check import CalibrationCheck
from velod.optimizer.dead_reckoning import DeadReckoning
from velod.optimizer.estimator import Estimator
from velod.optimizer.frame import output_frame
from velod.optimizer.inertial import continues
from velod.optimizer.parts import Parts, batch_seq
from velod.optimizer.rotation_check import Offsets
from velod.ticks import tick_after, tick_ns
from velod.types import F64, NS_PER_S, DepthBatch, FlowBatch, ImuSamples, Odometry, TrackingState, Velocity

UNKNOWN_SIGMA = 100.0
"""Of a velocity nothing is known about, m/s."""
MIN_BATCHES = 3
"""Batches with a velocity before the first valid one."""
VALID_SIGMA, VALID_SHARE = 0.1, 0.01
"""A velocity becomes valid when its largest sigma is below VALID_SIGMA m/s + VALID_SHARE of its speed ..."""
EARLY_NS, EARLY_FACTOR = 70_000_000, 0.5
"""... times EARLY_FACTOR while less than EARLY_NS have been seen, when gravity is hardly known ..."""
LATE_NS, LATE_SIGMA = 300_000_000, 0.2
"""... or below LATE_SIGMA m/s from LATE_NS on: a velocity that tells its uncertainty is worth more than none ..."""
SETTLED_NS, SETTLED_SIGMA = NS_PER_S, 0.3
"""... or SETTLED_SIGMA once a window is full: a poor IMU will not know it better ..."""
LOST_FACTOR = 4.0
"""... and stays valid until it is this many times larger."""
DEGRADED_AFTER_NS = 100_000_000
"""Without usable flow for so long the estimate runs on the IMU alone."""
CLOCK_RESTART_NS = 10 * NS_PER_S
"""Events this far back in time mean that the sensor's clock was set anew."""
IMU_GAP_NS = NS_PER_S // 10
"""A longer hole in the IMU cannot be bridged, for nobody knows how the sensor turned: start anew."""

NOISE = "imu.noise"
ALARM_NOISE = 2.0
"""Times the specified noise density of the IMU from which on an alarm asks whether the settings are of this IMU."""


@dataclass(frozen=True, slots=True)
class _Unchecked:
    """A batch that was taken in, with what the estimator then said of it."""

    flow: FlowBatch
    depth: DepthBatch
    own_solution: tuple[int, F64, F64] | None
    offsets: Offsets | None


class OptimizerStage:
    """``handle(FlowBatch | DepthBatch | ImuSamples) -> [Velocity | Odometry]``."""

    def __init__(self, settings: Settings, calibration: Calibration) -> None:
        self._settings, self._calibration = settings, calibration
        self._frame = output_frame(settings.optimizer.frame, calibration)
        self._hz = settings.optimizer.output_hz
        wait = settings.optimizer.max_wait_ms
        self._max_wait_ns = int(wait * 1e6) if np.isfinite(wait) else None
        ingest = for_sensor(settings, calibration.left.width, calibration.left.height).ingest
        self._silence_ns = None if ingest.batch == "count" else round(ingest.period_ms * 1e6)
        self.counters: dict[str, int] = {}
        self._seq = 0
        self._reckoning = DeadReckoning(settings.optimizer.window_s, settings.imu.gyro_noise)
        self._pending: dict[int, Parts] = {}  # by the number of the batch
        self._ends: dict[int, int] = {}  # seq -> end of closed batches that have not been taken in
        self._taken: set[int] = set()  # taken in before an earlier one that is still missing
        self._next_seq = -1  # first batch not yet taken in nor given up; -1: nothing heard from ingest yet
        self._closed_seq = -1  # newest batch that ingest has closed
        self._unchecked: list[_Unchecked] = []  # against the calibration
        self._reset()
        self._check = CalibrationCheck(settings.optimizer, settings.imu, self._estimator.camera)
        self.alarms, self.gauges = self._check.alarms, self._check.gauges

    def _reset(self) -> None:
        self._estimator = Estimator(self._settings, self._calibration)
        self._estimator.counters = self.counters
        self._forget_batches()
        self._imu_t_ns = NEVER  # newest sample
        self._event_t_ns = NEVER
        self._now_ns = NEVER  # newest sensor time heard of
        self._tick = NEVER  # number of the next velocity on the grid of the output rate
        self._was_valid = self._was_lost = False
        self._newest = (-1, 0)  # seq and t_ns of the newest batch taken in
        self._silent_to = NEVER  # without an event since the newest batch

    def handle(self, message: FlowBatch | DepthBatch | ImuSamples) -> list[Velocity | Odometry]:
        """Take one message; return the velocities that it completes, a valid one with its dead reckoning.

        Raises TypeError for other messages.
        """
        self.tidy()
        if isinstance(message, ImuSamples):
            self._take_imu(message)
        elif isinstance(message, FlowBatch | DepthBatch):
            self._take_part(message)
        else:
            raise TypeError(f"the optimizer does not take {type(message).__name__}")
        self._now_ns = max(self._now_ns, message.t_ns)
        return self._advance()

    @property
    def time_offset_s(self) -> float:
        """Of the IMU's clock, by the calibration: t_imu = t_cam + time_offset_s."""
        return self._calibration.time_offset_s

    def reset_odometry(self) -> None:
        """Begin a new dead reckoning with the next valid velocity."""
        self._reckoning.stop()
        self._count("odometry.reset")

    def _count(self, name: str, by: int = 1) -> None:
        self.counters[name] = self.counters.get(name, 0) + by

    def _take_part(self, part: FlowBatch | DepthBatch) -> None:
        """Keep one part of a batch until the others come; what is of no use is counted."""
        seq = batch_seq(part)
        if seq in self._taken or seq < self._next_seq:
            self._count("batch.duplicate")
            return
        if not self._pending.setdefault(seq, Parts()).add(part):
            self._count("batch.of_another_ingest")

    def _take_imu(self, m: ImuSamples) -> None:
        # An ingest that has not heard of any event yet says 0: then the IMU tells.
        if (m.event_t_ns or m.t_ns) + CLOCK_RESTART_NS < self._event_t_ns:
            self._count("clock.restart")
            self._reset()
        elif m.batch_seq < self._closed_seq:
            self._count("ingest.restart")
            self._forget_batches()
        if self._next_seq < 0:
            self._next_seq = m.batch_seq + 1
            # what came before the first word of ingest belongs to the past
            self._pending = {s: p for s, p in self._pending.items() if s >= self._next_seq}
        for seq in range(max(self._closed_seq + 1, self._next_seq), m.batch_seq + 1):
            self._ends[seq] = m.batch_t_ns  # exact for the newest, the latest possible for one not heard of
        self._closed_seq = m.batch_seq
        self._event_t_ns = max(self._event_t_ns, m.event_t_ns or NEVER)
        self._append_samples(m)

    def _forget_batches(self) -> None:
        """Nothing is known of the batches of this ingest yet."""
        self._pending.clear()
        self._ends.clear()
        self._taken.clear()
        self._next_seq = -1
        self._closed_seq = -1

    def _append_samples(self, m: ImuSamples) -> None:
        t_ns = m.sample_t_ns
        if self._tick != NEVER and continues(t_ns, self._imu_t_ns, IMU_GAP_NS):
            self._estimator.add_imu(m)
            self._imu_t_ns = int(t_ns[-1])
        elif len(t_ns):
            self._append_uneven(m)

    def _append_uneven(self, m: ImuSamples) -> None:
        """Samples that begin anew, go back or have holes."""
        new = m.sample_t_ns > self._imu_t_ns
        if not new.all():
            self._count("imu.backwards", int((~new).sum()))
        if not new.any():
            return
        t, accel, gyro = m.sample_t_ns[new], m.accel[new], m.gyro[new]
        before = t[0] if self._imu_t_ns == NEVER else self._imu_t_ns
        holes = np.flatnonzero(np.diff(t, prepend=before) > IMU_GAP_NS).tolist()
        for first, end in pairwise(sorted({0, *holes, len(t)})):
            if first in holes:
                self._count("imu.gap_restart")
                self._restart_after_gap()
            part = slice(first, end)
            self._estimator.add_imu(replace(m, sample_t_ns=t[part], accel=accel[part], gyro=gyro[part]))
            if self._tick == NEVER and end > first:
                self._tick = tick_after(int(t[first]) - 1, self._hz)
        self._imu_t_ns = int(t[-1])

    def _restart_after_gap(self) -> None:
        check = self._estimator.rotation_check
        check.forget_pending()
        self._estimator = Estimator(self._settings, self._calibration, check)
        self._estimator.counters = self.counters
        self._was_valid, self._was_lost = False, self._was_valid or self._was_lost
        self._tick = NEVER

    def _advance(self) -> list[Velocity | Odometry]:
        """Everything that can be done now, in sensor-time order."""
        out: list[Velocity | Odometry] = []
        while self._tick != NEVER:
            tau = tick_ns(self._tick, self._hz)
            complete = self._take_in_order(tau)
            if self._imu_t_ns < tau:
                break
            if not complete:
                if self._max_wait_ns is None or self._imu_t_ns < tau + self._max_wait_ns:
                    break
                self._count("velocity.without_batch")
                self._take_out_of_order(tau)
            else:
                self._take_in_silence(tau)
            out += self.put_out(tau)
            self._tick += 1
        return out

    def _take_in_order(self, tau: int) -> bool:
        """Take in the batches that ended by ``tau``; False while one of them, or word of the events, is missing."""
        while self._next_seq >= 0:
            depth = self._whole(self._next_seq)
            if self._next_seq in self._taken:
                self._next_after(self._next_seq)
            elif depth is not None:
                if depth.t_ns > tau:
                    return True
                if depth.t_ns > self._imu_t_ns:
                    return False
                self._take_in(self._next_seq, depth)
                self._next_after(self._next_seq)
            elif self._next_seq <= self._closed_seq:
                return self._ends[self._next_seq] > tau
            else:
                return self._event_t_ns >= tau
        return False

    def _take_in_silence(self, tau: int) -> None:
        """An empty batch where there has certainly been no left event, which ingest makes no batches of for ever.

        An event opens a batch, and a batch ends within a period: all those that ended by ``tau`` have been taken in.
        """
        if self._silence_ns is None or self._newest[0] < 0:
            return
        t_ns = tau - self._silence_ns
        if t_ns >= max(self._newest[1], self._silent_to) + self._silence_ns:
            self._estimator.absorb(*nothing(t_ns))
            self._silent_to = t_ns

    def _take_out_of_order(self, tau: int) -> None:
        """Take in whatever is complete, and give up what is about to leave the window."""
        for seq in sorted(self._pending):
            depth = self._whole(seq)
            if depth is not None and depth.t_ns <= tau:
                self._take_in(seq, depth)
                self._taken.add(seq)
        oldest = tau - int(self._settings.optimizer.window_s * NS_PER_S)
        while 0 <= self._next_seq <= self._closed_seq:
            if self._next_seq not in self._taken:
                if self._ends[self._next_seq] > oldest:
                    return
                self._count("batch.lost")
            self._next_after(self._next_seq)

    def _next_after(self, seq: int) -> None:
        self._pending.pop(seq, None)
        self._ends.pop(seq, None)
        self._taken.discard(seq)
        self._next_seq = seq + 1

    def _whole(self, seq: int) -> DepthBatch | None:
        """The depth of a batch of which all parts are there."""
        parts = self._pending.get(seq)
        return None if parts is None else parts.whole

    def _take_in(self, seq: int, depth: DepthBatch) -> None:
        flow = self._pending.pop(seq).joined(depth)
        if not self._estimator.memory.covers(flow.t_ns, flow.t_ns):
            self._count("batch.before_imu")
            return
        head = self._estimator.head
        if head is not None and flow.t_ns < head.t_ns:
            self._count("late.taken_in")
            if not self._estimator.window.contains(flow.t_ns):
                self._count("batch.too_late")
                return
        self._estimator.absorb(flow, depth)
        own, offsets = self._estimator.own_solution, self._estimator.rotation_check.offsets
        self._unchecked.append(
            _Unchecked(flow, depth, own if own is not None and own[0] == flow.t_ns else None, offsets)
        )
        self._check_noise()
        if self._newest[0] < 0 or flow.t_ns > self._newest[1]:
            self._newest = (seq, flow.t_ns)

    def tidy(self) -> None:
        """Check the calibration against the newest batches: no velocity needs to wait for that."""
        for batch in self._unchecked:
            self._check.add_batch(batch.flow, batch.depth)
            if batch.own_solution is not None:
                self._check.add_solution(*batch.own_solution)
            if batch.offsets is not None:
                self._check.add_offsets(batch.offsets)
        self._unchecked.clear()

    def _check_noise(self) -> None:
        """The IMU's noise as it shows, for all who reckon with it; an alarm where it is far from the settings."""
        noise = self._estimator.imu_noise
        self._reckoning.gyro_noise = noise.settings.gyro_noise
        self._check.use_noise(noise.settings)
        accel, gyro = noise.excess
        noisy = f"the accelerometer has {accel:.1f} and the gyroscope {gyro:.1f} times the noise of the settings"
        self.alarms.say(NOISE, noisy if max(accel, gyro) > ALARM_NOISE else "")

    def put_out(self, tau: int) -> list[Velocity | Odometry]:
        """The velocity at ``tau`` from what has been taken in; with its dead reckoning where it is valid."""
        attitude = self._estimator.attitude(tau)
        if attitude is not None and not self._frame.is_imu:
            attitude = attitude.seen_from(self._frame.R_FB)
        velocity = self._velocity(tau, attitude)
        if not velocity.valid or attitude is None:
            self._reckoning.stop()
            return [velocity]
        at = (attitude.R_LB, attitude.up_B, attitude.up_cov)
        odometry = self._reckoning.update(tau, velocity.v_B, velocity.cov, *at)
        return [velocity, replace(odometry, age_ms=velocity.age_ms)]

    def _velocity(self, tau: int, attitude: Attitude | None) -> Velocity:
        predicted = self._estimator.output(tau)
        if predicted is None:
            v, cov = np.zeros(3), np.eye(3) * UNKNOWN_SIGMA**2
        else:
            v, cov = predicted
        weak_B = self._estimator.degenerate(tau)
        if not self._frame.is_imu and (rate := self._estimator.rate(tau)) is not None:
            v, cov = self._frame.velocity(v, cov, rate)
            weak_B = weak_B @ self._frame.R_FB.T
        state, reason, valid = self._judge(tau, v, cov, weak_B)
        known: dict[str, Any] = {}
        if len(weak_B):
            known["degenerate_B"] = np.vstack([weak_B, np.zeros((3, 3))])[:3]
        if attitude is not None:
            known["up_B"], known["up_cov"] = attitude.up_B, attitude.up_cov
        self._seq += 1
        return Velocity(
            self._seq - 1, tau, v, cov, valid, state, reason, *self._newest,
            age_ms=(self._now_ns - tau) * 1e-6, frame=self._frame.name, degenerate=len(weak_B), **known,
        )  # fmt: skip

    def _judge(self, tau: int, v: F64, cov: F64, weak_B: F64) -> tuple[str, str, bool]:
        """State, reason and validity of an estimate."""
        sigma = float(np.sqrt(np.linalg.eigvalsh(cov)[-1]))
        limit = VALID_SIGMA + VALID_SHARE * float(np.linalg.norm(v))
        disagreement = self._estimator.disagreement
        if self._estimator.consistency.on_probation:
            self._was_valid, self._was_lost = False, True
            return TrackingState.LOST, disagreement, False
        if impossible := self._estimator.implausible_bias:
            self._was_lost |= self._was_valid
            self._was_valid = False
            return TrackingState.LOST if self._was_lost else TrackingState.INITIALISING, impossible, False
        if not self._was_valid:
            state = TrackingState.LOST if self._was_lost else TrackingState.INITIALISING
            if self._estimator.batches < MIN_BATCHES:
                why = "" if self._estimator.batches else f"; the newest: {self._estimator.lacking}"
                return state, f"{self._estimator.batches} usable batches{why}", False
            if self._estimator.probation.lasts(tau):
                return state, "a moment ago the cameras did not see the same", False
            seen_ns = tau - self._estimator.first_usable_t_ns
            # nothing may speak against IMU or calibration: what is uncertain for that is wrong
            late = seen_ns >= LATE_NS and not self._was_lost and self._estimator.biases_as_specified
            patient = SETTLED_SIGMA if seen_ns >= SETTLED_NS else LATE_SIGMA
            if sigma > (EARLY_FACTOR * limit if seen_ns < EARLY_NS else max(limit, patient) if late else limit):
                return state, self._uncertain(tau, sigma), False
            self._was_valid, self._was_lost = True, False
        if sigma > LOST_FACTOR * limit:
            self._was_valid, self._was_lost = False, True
            return TrackingState.LOST, self._uncertain(tau, sigma), False
        if without_flow := self._without_flow(tau):
            return TrackingState.DEGRADED, without_flow, True
        if disagreement:
            return TrackingState.DEGRADED, disagreement, True
        if len(weak_B):
            along = ", ".join("[{:+.2f} {:+.2f} {:+.2f}]".format(*direction) for direction in weak_B)
            return TrackingState.DEGRADED, f"degenerate: the flows say nothing along {along}", True
        return TrackingState.TRACKING, "", True

    def _uncertain(self, tau: int, sigma: float) -> str:
        why = (f"sigma {sigma:.2f} m/s", self._without_flow(tau), self._estimator.testimony)
        return "; ".join(filter(None, why))

    def _without_flow(self, tau: int) -> str:
        """For how long there has been none, and why; empty where there is flow."""
        alone_ns = tau - self._estimator.last_usable_t_ns
        if alone_ns <= DEGRADED_AFTER_NS or self._estimator.batches == 0:
            return ""
        why = "dark or covered" if self._estimator.dark else self._estimator.lacking
        return f"no flow for {alone_ns * 1e-6:.0f} ms: {why}"


def nothing(t_ns: int) -> tuple[FlowBatch, DepthBatch]:
    """A batch that ended at ``t_ns`` without an event."""
    u2, f4, rows = np.empty(0, np.uint16), np.empty(0, np.float32), np.empty((0, 2), np.float32)
    return (
        FlowBatch(-1, t_ns, 0, u2, np.empty(0, np.uint32), f4, f4, rows, f4, f4, n_events=0),
        DepthBatch(-1, t_ns, 0, u2, f4, f4, f4, np.empty(0, np.uint8)),
    )
