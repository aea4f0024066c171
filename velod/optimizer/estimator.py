"""From batches of flow and depth and IMU samples to the velocity, in sensor time, without I/O."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from velod.config import ImuSettings, Settings
from velod.events.sae import NEVER
from velod.events.sensor_size import for_sensor
from velod.geometry.calibration import Calibration
from velod.geometry.rectify import rectified_pair
from velod.optimizer import attitude, batch_fit, degeneracy, inertial_residual, overlap
from velod.optimizer.attitude import Attitude
from velod.optimizer.batch_fit import RIDGE, Fit
from velod.optimizer.bias_prior import EXCESSIVE, implausible, likely_margins
from velod.optimizer.bins import BIN_NS, Bins, compress
from velod.optimizer.consistency import Consistency
from velod.optimizer.depth_share import Probation, cameras_disagree
from velod.optimizer.equations import EquationMaker, Equations, Prediction
from velod.optimizer.flow_equation import COMMON, Rows, less_known, span
from velod.optimizer.frame import Rate
from velod.optimizer.head import Head
from velod.optimizer.imu_noise import ImuNoise
from velod.optimizer.inertial import InertialMemory
from velod.optimizer.interval import Interval
from velod.optimizer.preintegration import Preintegration, preintegrate
from velod.optimizer.rotation_check import RotationCheck
from velod.optimizer.small import squared_distance
from velod.optimizer.standstill import QUIET_EVENTS, QUIET_NS, Standstill
from velod.optimizer.window import Window
from velod.optimizer.witness import Witness
from velod.types import F64, NS_PER_S, DepthBatch, FlowBatch, ImuSamples

OPEN_NS = 60_000_000
"""An interval is open so long for flows of batches to come, which select events up to half the memory old."""
SMOOTHNESS = {"error": 0.5, "velocity": 5.0}
"""Weak sigma of the second difference of control points, m/s, by what the spline models."""
INNOVATION_GATE = 25.0
"""Squared Mahalanobis distance from which a batch that contradicts the prediction loses weight (5 sigma)."""
RESTING_SIGMA = 0.002
"""m/s, of what may have begun since rest was observed last and the IMU does not show."""
NOISE_TRIAL_NS, MUCH_NOISIER = 300_000_000, 1.5
"""Noise that is found so soon, and so much more of it, was in all that has been taken in."""
USUAL_DEPTH = 3.0
"""m, before any was seen."""
MAX_INTEGRATED = 1000.0
"""m/s; s_L, which gravity makes grow without end, is counted anew beyond this."""
MAX_CARRIED = 32
"""Predictions of one head that are remembered: a batch asks for some of them twice."""
MAX_DIRECTION_SIGMA = 0.5
"""rad; gravity's direction must be known this well before its norm says anything."""


class Estimator:
    """Sliding-window estimate of v_B by Eq. 14 with the states of Eq. 12 and gravity."""

    def __init__(
        self, settings: Settings, calibration: Calibration, rotation_check: RotationCheck | None = None
    ) -> None:
        """``rotation_check``: that of the estimator before, of the same rig."""
        o = settings.optimizer
        rect = rectified_pair(calibration)
        ingest = for_sensor(settings, calibration.left.width, calibration.left.height).ingest
        self._o, self._ingest = o, ingest
        self.imu_noise = ImuNoise(settings.imu)
        self.camera = (rect.f, rect.cx, rect.cy)
        self._maker = EquationMaker(self.camera, rect.R_CB, rect.p_BC_B)
        self._knot_ns = int(o.knot_s * NS_PER_S)
        self._interval_ns = int(o.preintegration_s * NS_PER_S)
        self.counters: dict[str, int] = {}
        self.memory = InertialMemory(o.window_s + 3.0)
        self._segments = int(np.ceil(o.window_s / o.knot_s)) + 1
        self._bias_margins = (1.0, 1.0)  # on the specified sigmas of b_a and b_w
        self.probation = Probation()
        self.consistency = Consistency()
        self._witness = Witness()
        self.rotation_check = rotation_check or RotationCheck(
            o.imu_clock_sigma_ms * 1e-3, settings.imu.gyro_noise, o.correct_imu_clock
        )
        self._standstill = Standstill(settings.imu, calibration.left.width * calibration.left.height)
        self._forget()

    @property
    def _imu(self) -> ImuSettings:
        return self.imu_noise.settings

    def _forget(self) -> None:
        """Nothing is known of the velocity."""
        o = self._o
        common_sigma = np.array([o.flow_scale_sigma, o.delay_sigma_ms * 1e-3, o.depth_scale_sigma])
        self.window = Window(
            self._imu, self._knot_ns, self._segments, SMOOTHNESS[o.spline], common_sigma, self._bias_margins,
            o.shared_gyro_noise,
        )  # fmt: skip
        self.head: Head | None = None
        self.batches = 0  # that gave a velocity
        self.first_usable_t_ns = self.last_usable_t_ns = NEVER
        self.own_solution: tuple[int, F64, F64] | None = None  # end of the newest batch with one, s_L there, its e
        self._open: list[Interval] = []  # that may get flows yet; the last one is incomplete
        self._started_ns = 0
        self._bias_doubt = np.zeros((6, 6))  # for their margins, when this was known of them:
        self._bias_information = np.zeros((6, 6))
        self._depth_m = USUAL_DEPTH  # median of the newest batch
        self._still_to = NEVER  # up to here rest has been observed
        self._weak_L: F64 = np.empty((0, 3))  # directions that the newest batch with flow does not constrain
        self.lacking = "no events"  # why the newest batch gave no velocity
        # t_ns -> the IMU up to there and the prediction, from the head ``_carried_from``
        self._carried: dict[int, tuple[Preintegration, F64, F64]] = {}
        self._carried_from: Head | None = None

    def add_imu(self, samples: ImuSamples) -> None:
        """Remember IMU samples, later than all before."""
        if spikes := self.memory.append(samples.sample_t_ns, samples.accel, samples.gyro):
            self._count("imu.spike", spikes)

    def absorb(self, flow: FlowBatch, depth: DepthBatch) -> None:
        """Take a batch in; the IMU must cover its end. A batch older than the head adds what it knows."""
        self.memory.integrate_to(flow.t_ns, *self._biases())
        self._look_at_noise(flow.t_ns)
        self._start_anew_where_it_is_wrong(flow.t_ns)
        self._widen_bias_prior()
        self._correct_stamps(flow.t_ns)
        equations = self._equations(flow, depth)
        late = self.head is not None and flow.t_ns <= self.head.t_ns
        predicted = None if late or self.head is None else self.predict(flow.t_ns)
        still = (
            not late
            and self._o.zero_velocity
            and self._standstill.detected(flow, self.memory, self._biases()[1], predicted)
        )
        if self.window.empty:
            if equations is None and not still:
                return
            self._start(flow.t_ns - QUIET_NS if equations is None else int(equations.on_error.t_ns.min()), flow.t_ns)
        if not late:
            self._extend_to(flow.t_ns)
        if equations is not None:
            self._add_flow(flow.t_ns, equations, predicted)
        elif still:
            self._add_standstill(flow.t_ns)
        self._solve_head(self.head.t_ns if late and self.head is not None else flow.t_ns)
        self._hear_witness()
        self._keep_error_small()

    def _look_at_noise(self, t_ns: int) -> None:
        """Use the noise that the IMU shows; an estimate that began with much less of it begins anew."""
        before = self._imu
        if not self.imu_noise.look(self.memory, t_ns):
            return
        self._count("imu.noise_changed")
        self.rotation_check.gyro_noise = self._imu.gyro_noise
        self._standstill.imu = self._imu
        if self.window.empty:
            return
        more = max(self._imu.accel_noise / before.accel_noise, self._imu.gyro_noise / before.gyro_noise)
        if more > MUCH_NOISIER and t_ns - self._started_ns < NOISE_TRIAL_NS:
            self._forget()
        else:
            self.window.use_noise(self._imu)
            for interval in self._open:
                interval.noise_changed()

    def _start_anew_where_it_is_wrong(self, t_ns: int) -> None:
        """Forget an estimate that no further batch can save."""
        if not self.window.empty and not self.memory.covers(self._open[-1].t_i, t_ns):
            self._count("estimate.restart_after_hole")
            self._forget()
        elif self.consistency.hopeless:
            self._count("estimate.restart_on_disagreement")
            self.consistency.start_anew()
            self._forget()

    def _widen_bias_prior(self) -> None:
        """As wide as the biases make likely that are found, while their prior is in the window."""
        head = self.head
        if head is None or not self._o.widen_bias_prior or not self.window.holds_start:
            return
        imu, seconds = self._imu, (head.t_ns - self._started_ns) * 1e-9
        sigma = np.repeat([imu.accel_bias_sigma, imu.gyro_bias_sigma], 3)
        walked = np.repeat([imu.accel_bias_walk, imu.gyro_bias_walk], 3) ** 2 * seconds
        biases = np.concatenate([head.b_a, head.b_w])
        likely = likely_margins(biases, head.cov[3:9, 3:9], sigma, walked, self._bias_margins)
        self._bias_doubt, self._bias_information = likely.doubt, likely.information
        if likely.margins != self._bias_margins:
            self._bias_margins = likely.margins
            self.window.widen_bias_prior(likely.margins)
            self._count("bias.prior_changed")

    def _doubt_of_margins(self, t_ns: int) -> F64:
        """Covariance (3, 3) of v_B at ``t_ns`` for other margins of the biases than those in use.

        What is learnt after the prior has left the window lets the states follow a bias less and less.
        """
        head = self.head
        if head is None or not self._bias_doubt.any():
            return np.zeros((3, 3))
        p, v_B, _ = self._carry(head, t_ns)
        J = inertial_residual.carried_jacobian(p, v_B, head.R_LB) @ head.cov[:, 3:9] @ self._bias_information
        doubt_B: F64 = J @ self._bias_doubt @ J.T
        return doubt_B

    def _hear_witness(self) -> None:
        """Compare the newest estimate with the one that the IMU alone has carried on since flow and IMU disagree."""
        head = self.head
        if head is None:
            return
        suspicious = bool(self.consistency.disagreement)
        self._witness.watch(head, suspicious=suspicious)
        before = self._witness.head
        if before is not None and self.memory.covers(before.t_ns, head.t_ns):
            p = self._preintegrate(before.t_ns, head.t_ns, before.b_a, before.b_w)
            carried = inertial_residual.carry(p, before.v_B, before.R_LB, before.g_L, before.cov)
            self._witness.compare(head, *carried, suspicious=suspicious)

    def _doubt(self, t_ns: int) -> F64:
        """Covariance (3, 3) in B at ``t_ns`` for what the estimate has moved away from the witness."""
        head, doubt_L = self.head, self._witness.doubt_L
        if head is None or not doubt_L.any():
            return np.zeros((3, 3))
        R_LB = head.R_LB @ self._carry(head, t_ns)[0].R_gamma
        doubt_B: F64 = R_LB.T @ doubt_L @ R_LB
        return doubt_B

    def _correct_stamps(self, t_ns: int) -> None:
        """Take the delay of the events out of their stamps, once it is certain."""
        if (step_s := self.rotation_check.advance(self.memory, t_ns)) != 0.0:
            self._count("clock.corrected")
            self._shift(np.zeros(3), np.array([0.0, -step_s, 0.0]))
            self.window.begin_common_anew(COMMON.index("delay"))

    def predict(self, t_ns: int) -> tuple[F64, F64] | None:
        """v_B (3,) and its covariance (3, 3) at ``t_ns``, carried there from the head by the IMU (Eq. 10)."""
        head = self.head
        if head is None or not self.memory.covers(head.t_ns, t_ns):
            return None
        _, v, cov = self._carry(head, t_ns)
        return v.copy(), cov.copy()

    def output(self, t_ns: int) -> tuple[F64, F64] | None:
        """``predict`` with the covariance that is due where flow and IMU disagree.

        And rest, where there was rest at the head and the IMU has been quiet since.
        """
        predicted = self.predict(t_ns)
        if predicted is None:
            return None
        v, cov = predicted[0], predicted[1] * self.consistency.factor + self._doubt(t_ns)
        cov = cov + self._doubt_of_margins(t_ns)
        if not self._standstill.goes_on(self.memory, t_ns, self._biases()[1]):
            return v, cov
        sigma = max(self._still_sigma(), RESTING_SIGMA)
        gain = cov @ np.linalg.inv(cov + np.eye(3) * sigma**2)
        return v - gain @ v, cov - gain @ cov

    def rate(self, t_ns: int) -> Rate | None:
        """Angular velocity at ``t_ns`` for a velocity that ``output`` gave."""
        head = self.head
        if head is None or not self.memory.covers(head.t_ns, t_ns):
            return None
        p = self._carry(head, t_ns)[0]
        J = inertial_residual.carried_jacobian(p, self._carry(head, t_ns)[1], head.R_LB)
        w_B, share = self.memory.rate_at(t_ns)
        noise_cov = np.eye(3) * self._imu.gyro_noise**2 * share
        factor = self.consistency.factor
        return Rate(w_B - head.b_w, noise_cov, head.cov[6:9, 6:9] * factor, J @ head.cov[:, 6:9] * factor)

    def attitude(self, t_ns: int) -> Attitude | None:
        """Which way is up at ``t_ns``, carried there from the head by the gyroscope; None while that is unknown."""
        head = self.head
        if head is None or not self.memory.covers(head.t_ns, t_ns):
            return None
        if head.gravity_direction_sigma > MAX_DIRECTION_SIGMA:
            return None
        return attitude.carry(self._carry(head, t_ns)[0], head.R_LB, head.g_L, head.cov[6:, 6:])

    def _carry(self, head: Head, t_ns: int) -> tuple[Preintegration, F64, F64]:
        if self._carried_from is not head or len(self._carried) >= MAX_CARRIED:
            self._carried_from = head
            self._carried.clear()
        if t_ns not in self._carried:
            p = self._preintegrate(head.t_ns, t_ns, head.b_a, head.b_w)
            self._carried[t_ns] = (p, *inertial_residual.carry(p, head.v_B, head.R_LB, head.g_L, head.cov))
        return self._carried[t_ns]

    def degenerate(self, t_ns: int) -> F64:
        """Directions (k, 3) in B at ``t_ns`` of which the last flows say nothing; unit vectors."""
        head = self.head
        if head is None or not self.memory.covers(head.t_ns, t_ns):
            return np.empty((0, 3))
        return self._weak_L @ head.R_LB @ self._carry(head, t_ns)[0].R_gamma

    @property
    def biases_as_specified(self) -> bool:
        """Whether no bias has been found that was not drawn with its sigma."""
        return max(self._bias_margins) < EXCESSIVE

    @property
    def disagreement(self) -> str:
        """Of flow and IMU, in words; empty where they agree."""
        return self.testimony or self.consistency.disagreement

    @property
    def testimony(self) -> str:
        """How far the estimate has left what the IMU alone made of it, in words; empty while noise explains that."""
        return self._witness.testimony

    @property
    def implausible_bias(self) -> str:
        """What is taken for a bias and cannot be one, in words; empty if nothing is."""
        return "" if self.head is None else implausible(self.head.b_a, self.head.b_w, self._imu)

    @property
    def dark(self) -> bool:
        """Whether the sensor moves and sees nothing."""
        return self._standstill.dark

    def _biases(self) -> tuple[F64, F64]:
        return (np.zeros(3), np.zeros(3)) if self.head is None else (self.head.b_a, self.head.b_w)

    def _count(self, name: str, by: int = 1) -> None:
        self.counters[name] = self.counters.get(name, 0) + by

    def _preintegrate(
        self, t_i: int, t_j: int, b_a: F64, b_w: F64, gyro_noise: float | None = None
    ) -> Preintegration:
        m, imu = self.memory, self._imu
        noise = imu.gyro_noise if gyro_noise is None else gyro_noise
        return preintegrate(m.t_ns, m.accel, m.gyro, t_i, t_j, b_a, b_w, imu.accel_noise, noise)

    def _frame(self, t_ns: int) -> tuple[F64, F64, F64]:
        """R_LB and the affine map from spline to body velocity at ``t_ns``: v_B = N + M spline(t)."""
        R_LB, s_L = self.memory.frame_at(t_ns)
        if self._o.spline == "velocity":
            return R_LB, np.zeros(3), np.eye(3)
        M = np.ascontiguousarray(R_LB.T)
        return R_LB, M @ s_L, M

    def _equations(self, flow: FlowBatch, depth: DepthBatch) -> Equations | None:
        """Of the events of which both flow and depth speak; None where they are too few."""
        disagree = cameras_disagree(depth)
        self.probation.note(flow.t_ns, disagree=disagree)
        if disagree:
            self._count("fit.few_depths")
            self.lacking = _lack(flow, depth)
            return None
        earliest_ns = int(self.memory.t_ns[0])
        if not self.window.empty:
            earliest_ns = max(earliest_ns, self.window.first * self._knot_ns)
        head = self.head
        known = None if head is None else Prediction(head.t_ns, head.e_L, head.g_L)
        equations = self._maker.make(flow, depth, self.memory, earliest_ns, known, self.rotation_check.late_ns)
        if len(equations.on_error.z) < self._o.min_flows:
            if flow.n_selected > 0:
                self._count("fit.few_flows")
            self.lacking = _lack(flow, depth)
            return None
        self._depth_m = equations.depth_m
        return equations

    def _fit(self, t_ns: int, equations: Equations) -> Fit | None:
        """The batch's own solution for e at ``t_ns``: gravity, which e holds, is taken from what is known of it.

        The sigmas of the rows are set on the way.
        """
        on_error, measured = equations.on_error, equations.measured
        # from the prediction on, so that a direction that no flow sees stays there
        common, predicted_e = np.zeros(3), np.zeros(3)
        if self.head is not None:
            common, predicted_e = self.head.common, self.head.e_at(t_ns)
        still = less_known(on_error, equations.common, common, -self._gravity(), predicted_e, t_ns)
        iterations, seed = self._o.ransac_iterations, self._o.seed + t_ns // 1000
        if self._o.weights == "fixed":
            still.sigma[:] = self._o.fixed_sigma_px_s
            fit = batch_fit.solve(still, iterations, seed, RIDGE)
        else:
            fit = batch_fit.solve_weighted(still, measured, iterations, seed, RIDGE)
        return None if fit is None else replace(fit, e=fit.e + predicted_e)

    def _start(self, t_ns: int, until_ns: int) -> None:
        """Open the window at ``t_ns``, with the mean specific force up to ``until_ns``."""
        _, s_L, _ = self.memory.at(np.array([t_ns, until_ns]))
        self.window.start(t_ns, (s_L[1] - s_L[0]) / max((until_ns - t_ns) * 1e-9, 1e-3))
        self._open = [self._interval_from(t_ns)]
        self._started_ns = t_ns

    def _extend_to(self, t_ns: int) -> None:
        """Open segments and add the inertial factors of the complete preintegration intervals up to ``t_ns``."""
        g_L = self._gravity()
        while not self.window.contains(t_ns):
            end = (self.window.last + 1) * self._knot_ns
            times = np.linspace(end - self._knot_ns, end, 21).astype(np.int64)
            R, _, _ = self.memory.at(np.maximum(times, self.memory.t_ns[0]))
            D_L = np.asarray(R.mean(axis=0)) * self._o.knot_s
            self.window.extend(D_L, g_L, self._biases()[1], self._o.knot_s)
            self._intervals_to(min(t_ns, end + self._knot_ns))
        self._intervals_to(t_ns)

    def _interval_from(self, t_i: int) -> Interval:
        return Interval(t_i, (t_i // self._interval_ns + 1) * self._interval_ns)

    def _intervals_to(self, t_ns: int) -> None:
        """Complete the intervals up to ``t_ns``, and close those that are old enough."""
        while (t_j := self._open[-1].t_j) <= t_ns and self.window.contains(t_j):
            self._linearise(self._open[-1], t_j)
            self._open.append(self._interval_from(t_j))
        while self._open[0].t_j <= t_ns - OPEN_NS and len(self._open) > 1:
            self.window.add_interval(self._open.pop(0))

    def _gravity(self) -> F64:
        return np.zeros(3) if self.head is None else self.head.g_L

    def _linearise(self, interval: Interval, t_j: int) -> None:
        """Eq. 14's inertial residual over [t_i, ``t_j``], in the frame B_i, its gyroscope noise by bins."""
        interval.until = t_j
        shared = self._o.shared_gyro_noise
        p = self._preintegrate(interval.t_i, t_j, *self._biases(), gyro_noise=0.0 if shared else None)
        R_LB, s_L, _ = self.memory.at(interval.times())
        head = self.head
        predicted = self.predict(t_j) if head is not None and t_j >= head.t_ns else None
        v_j = predicted[0] if predicted is not None else (np.zeros(3) if head is None else head.v_B)
        interval.linearise(p, R_LB, s_L, self._o.spline == "error", v_j)
        if head is not None and shared:
            interval.turn_by_noise(R_LB, s_L, head.e_at(t_j))

    def _add_flow(self, t_ns: int, equations: Equations, predicted: tuple[F64, F64] | None) -> None:
        fit = self._fit(t_ns, equations)
        if fit is None:
            self._count("fit.undetermined")
            self.lacking = "the flows do not determine a velocity"
            return
        weak_L = degeneracy.open_directions(equations.on_error, equations.measured, equations.across, fit)
        self._weak_L = weak_L
        self.own_solution = None if len(weak_L) else (t_ns, self.memory.frame_at(t_ns)[1], fit.e)
        shared = self._o.shared_error
        if predicted is not None:
            innovation = self._innovation(t_ns, equations.on_error, fit, predicted, weak_L)
            if self._o.weights == "propagated":  # a sigma that is fixed says nothing of what noise explains
                self.consistency.note(innovation)
            shared *= max(1.0, innovation / INNOVATION_GATE)
        if shared > self._o.shared_error:
            self._count("fit.inconsistent")
        on_spline = equations.on_error if self._o.spline == "error" else equations.on_velocity
        if self._o.weights == "propagated":
            times = overlap.times_seen(equations.measured.speed, self._ingest)
            on_spline = overlap.counted_once(on_spline, times)
        bins = compress(on_spline, equations.common, fit, shared, self._slope())
        if not len(weak_L) and predicted is not None and self.head is not None:
            R_LB, _ = self.memory.frame_at(t_ns)
            cov_e = R_LB @ predicted[1] @ R_LB.T
            self.rotation_check.add(bins, self._slope(), t_ns, self.head.e_at(t_ns), cov_e)
        if len(weak_L):
            self._count("fit.degenerate")
            R_LB, _, _ = self._frame(t_ns)
            degeneracy.without(bins.L, bins.eta, weak_L if self._o.spline == "error" else weak_L @ R_LB)
        self._share_out(bins)
        self._note_usable(t_ns)

    def _note_usable(self, t_ns: int) -> None:
        self.batches += 1
        self.first_usable_t_ns = t_ns if self.first_usable_t_ns == NEVER else self.first_usable_t_ns
        self.last_usable_t_ns = max(self.last_usable_t_ns, t_ns)

    def _slope(self) -> F64:
        """Of the spline, m/s^2, as far as it is known: e falls as gravity says."""
        return -self._gravity() if self._o.spline == "error" else np.zeros(3)

    def _share_out(self, bins: Bins) -> None:
        """Give each bin to the interval that it begins in, or to the window where that is closed."""
        upto = [interval.flows.first for interval in self._open[1:]]
        for interval, stop in zip(self._open, [*upto, bins.first + bins.count], strict=True):
            interval.add_flows(bins, stop, self._slope())
        for k in range(bins.first, min(self._open[0].flows.first, bins.first + bins.count)):
            alone = Interval(k * BIN_NS, (k + 1) * BIN_NS)
            alone.add_flows(bins, k + 1, self._slope())
            self.window.add_interval(alone)

    def _add_standstill(self, t_ns: int) -> None:
        """v_B = 0 at ``t_ns`` and w_B = 0 since the observation before, as observations."""
        _, N, M = self._frame(t_ns)
        self.window.add(M @ self.window.spline_row(t_ns), -N, np.eye(3) / self._still_sigma() ** 2)
        since_ns = max(self._still_to, t_ns - QUIET_NS)
        gyro = self.memory.gyro[self.memory.between(since_ns, t_ns)]
        if len(gyro):
            # what the gyroscope says is its bias, noise of the density over the root of the time, and a slow turn
            variance = self._imu.gyro_noise**2 / ((t_ns - since_ns) * 1e-9)
            variance += (self._standstill.unseen_px_s / self.camera[0]) ** 2
            J = self.window.selector(t_ns)[6:9]
            self.window.add(J, gyro.mean(axis=0), np.eye(3) / variance)
        self._still_to = t_ns
        self._weak_L = np.empty((0, 3))
        self._count("standstill")
        self._note_usable(t_ns)

    def _still_sigma(self) -> float:
        return self._standstill.sigma(self._depth_m / self.camera[0])

    def _innovation(self, t_ns: int, rows: Rows, fit: Fit, predicted: tuple[F64, F64], weak_L: F64) -> float:
        """Squared Mahalanobis distance of the batch's own velocity from the predicted one, as of three dimensions.

        The directions ``weak_L`` (k, 3), which the batch does not determine, do not count.
        """
        if len(weak_L) == 3:
            return 3.0
        R_LB, s_L = self.memory.frame_at(t_ns)
        d = s_L + fit.e - R_LB @ predicted[0]
        start_ns, end_ns = span(rows.t_ns)
        seen_s = max(end_ns - start_ns, BIN_NS) * 1e-9
        turned = batch_fit.turn_sensitivity(rows, fit) * self._imu.gyro_noise
        S = fit.cov * self._o.shared_error + turned @ turned.T / seen_s + R_LB @ predicted[1] @ R_LB.T
        if len(weak_L):
            seen = degeneracy.complement(weak_L)
            d, S = seen @ d, seen @ S @ seen.T
        return squared_distance(d, S) * 3.0 / len(d)

    def _keep_error_small(self) -> None:
        """Take from s_L what gravity has added to it, before the solution loses digits to it."""
        if self._o.spline == "error" and self.head is not None:
            _, s_L = self.memory.frame_at(self.head.t_ns)
            if s_L @ s_L > MAX_INTEGRATED**2:
                self.memory.shift(-s_L)
                self._shift(s_L, np.zeros(3))

    def _shift(self, offset_L: F64, common: F64) -> None:
        """Count e and the common errors from another origin: + offset (3,), + ``common`` (3,)."""
        if self.head is not None:
            self.head = replace(self.head, e_L=self.head.e_L + offset_L, common=self.head.common + common)
        if not self.window.empty:
            self.window.shift(offset_L, common)
        for interval in self._open:
            interval.shift(offset_L, common)

    def _solve_head(self, t_ns: int) -> None:
        """Optimum of the window and the state at ``t_ns``, with the IMU of the last incomplete interval."""
        if t_ns > self._open[-1].t_i:
            self._linearise(self._open[-1], t_ns)
        g_prior, g_sigma = None, 0.0
        if self.head is not None and (sigma := self.head.gravity_direction_sigma) < MAX_DIRECTION_SIGMA:
            g_prior, g_sigma = self.head.g_L, sigma
        solution = self.window.solve(self._open, g_prior, g_sigma)
        F = self.window.selector_with_common(t_ns)
        R_LB, N, M = self._frame(t_ns)
        x = F @ solution.x
        cov = solution.cov(F)
        cov[:3] = M @ cov[:3]
        cov[:, :3] = cov[:, :3] @ M.T
        v_B = N + M @ x[:3]
        e_L = x[:3] if self._o.spline == "error" else R_LB @ v_B - self.memory.frame_at(t_ns)[1]
        self.head = Head(
            t_ns, v_B, x[3:6], x[6:9], x[9:12], R_LB, cov[:12, :12].copy(), x[12:], cov[12:, 12:].copy(), e_L
        )


def _lack(flow: FlowBatch, depth: DepthBatch) -> str:
    """What there is too little of in a batch."""
    if flow.n_selected < QUIET_EVENTS:
        return "no events"
    if len(flow.index) <= len(depth.index):
        return f"{len(flow.index)} flows of {flow.n_selected} events"
    return f"{len(depth.index)} depths of {flow.n_selected} events"
