"""What velod is compared with (Sec. V-C): the IMU alone, the linear solver alone, other flow, other settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from velod.config import Settings
from velod.eval.dead_reckoning import attitude_at
from velod.eval.front_end import FrontEnd, event_times
from velod.eval.metrics import interpolated
from velod.geometry.calibration import Calibration
from velod.geometry.rectify import rectify
from velod.io.model import Imu, Truth
from velod.optimizer import batch_fit, flow_equation
from velod.optimizer.inertial import InertialMemory
from velod.types import F64, I64, NS_PER_S, ImuSamples, TrackingState, Velocity

NO_COVARIANCE = np.full((3, 3), np.nan)
NO_COMMON_ERROR = 1e-6
"""Sigma of a state that shall stay 0."""


def integrate_imu(imu: Imu, truth: Truth, settings: Settings) -> list[Velocity]:
    """The IMU integrated from the *true* initial velocity and attitude (Eq. 10), with biases taken as zero.

    The one baseline that is given truth, as the paper's is. At the optimizer's output rate; says nothing of its own
    covariance (NaN). Raises ValueError where the truth does not begin with the IMU or before it.
    """
    start_ns = int(imu.t_ns[0])
    if not truth.t_ns[0] <= start_ns <= truth.t_ns[-1]:
        raise ValueError("IMU integration needs the truth at the first IMU sample")
    memory = InertialMemory((int(imu.t_ns[-1]) - start_ns) / NS_PER_S + 1.0)
    memory.append(imu.t_ns, imu.accel, imu.gyro)
    memory.integrate_to(int(imu.t_ns[-1]), np.zeros(3), np.zeros(3))
    t_ns = output_times(start_ns, int(imu.t_ns[-1]), settings.optimizer.output_hz)
    R_LB, s_L, _ = memory.at(t_ns)
    # L is B at the first sample.
    g_L = attitude_at(truth, start_ns).T @ np.array([0.0, 0.0, settings.imu.gravity])
    v_start_L = interpolated(truth.t_ns, truth.v_B, np.array([start_ns]))[0]
    # Eq. 10 (with beta rotated by R_WB_i) in the frame L
    dt = (t_ns - start_ns)[:, None] / NS_PER_S
    v_L = v_start_L + s_L - g_L * dt
    v_B = np.einsum("nji,nj->ni", R_LB, v_L)
    return _velocities(t_ns, v_B)


def solve_linear(front_end: FrontEnd, settings: Settings, calibration: Calibration) -> list[Velocity]:
    """Eq. 15 on each batch alone, with the gyroscope's angular velocity: one velocity per batch, at its end.

    All flows of a batch count as simultaneous, as in the paper's footnote 2. A batch that does not determine a
    velocity, or with fewer than ``min_flows`` flows, gives none.
    """
    rect = rectify(calibration)
    camera = (rect.f, rect.cx, rect.cy)
    t_imu, gyro = _gyro(front_end)
    velocities: list[Velocity] = []
    for flow, depth in front_end.batches():
        t_ns = event_times(flow)
        if len(t_ns) < settings.optimizer.min_flows or t_ns.min() < t_imu[0] or t_ns.max() > t_imu[-1]:
            continue
        a_B, b_B = flow_equation.body_rows((flow.x, flow.y), flow.n, depth.inv_depth, camera, rect.R_CB, rect.p_BC_B)
        w_B = interpolated(t_imu, gyro, t_ns)
        speed = flow.speed.astype(np.float64)
        rows = flow_equation.on_velocity(t_ns, speed, a_B, b_B, w_B)
        measured = flow_equation.Measured(
            speed, flow.sigma.astype(np.float64), rows.z, depth.sigma / depth.inv_depth.astype(np.float64)
        )
        seed = settings.optimizer.seed + flow.seq
        fit = batch_fit.solve_weighted(rows, measured, settings.optimizer.ransac_iterations, seed)
        if fit is not None:
            velocities.append(_velocity(len(velocities), flow.t_ns, fit.e, fit.cov))
    return velocities


def benosman_settings(settings: Settings) -> Settings:
    """Benosman-NF of Table II: the reciprocal of each component of the temporal gradient [47], all else as it is."""
    return replace(settings, flow=replace(settings.flow, method="benosman"))


def paper_settings(settings: Settings) -> Settings:
    """What the paper says of its own pipeline, and no more.

    ingest   batches of 45k events (Sec. V-A); its three culling rules, so every event of a burst counts: no
             refractory time
    flow     Eq. 6 on a plane fitted and refitted without its outliers, as [47] does; 16 of 25 points left, as rule 2
             asks; no gate on the residual, of which the paper says nothing (velod's own gates would take most of
             these events: 62 % on boxes-4)
    depth    block matching alone (Sec. III-C), 17 x 17, 48 px (Sec. V-A): no plane coincidence, every match kept
    weights  one fixed P_c, "set empirically" (below Eq. 14), and so it is here: 20 px/s and a twentieth of the
             information were the best of 20 pairs (10 to 80 px/s, all to 1/500) over the first second of the eight
             sequences, boxes_esim and boxes_v2e; no common errors of flows, and the gyroscope's noise in the
             inertial term alone (Eq. 9, 14); biases with the sigmas that are specified
    spline   of the velocity itself (Eq. 7), knots of 0.1 s, preintegration over 0.03 s (Sec. V-A)

    The SAE reaches ``memory_ms`` back whatever a batch's length; the paper sets it no limit.
    Robust weights, gravity as a state and the start without an attitude stay velod's: Eq. 14 has no loss and needs
    the true initial attitude, which no run here is given.
    """
    return replace(
        settings,
        ingest=replace(
            settings.ingest, batch="count", count=45_000, selection="paper", refractory_ms=0.0, border_px=5
        ),
        flow=replace(settings.flow, rejections=2, min_neighbours=16, max_rms_px=5.0),
        depth=replace(settings.depth, block_px=17, max_disparity_px=48, refine=False, block_only="all"),
        optimizer=replace(
            settings.optimizer,
            spline="velocity",
            knot_s=0.1,
            preintegration_s=0.03,
            weights="fixed",
            fixed_sigma_px_s=20.0,
            shared_error=20.0,
            shared_gyro_noise=False,
            flow_scale_sigma=NO_COMMON_ERROR,
            depth_scale_sigma=NO_COMMON_ERROR,
            delay_sigma_ms=NO_COMMON_ERROR,
            correct_imu_clock=False,
            widen_bias_prior=False,
        ),
    )


def output_times(start_ns: int, end_ns: int, hz: float) -> I64:
    """Multiples of the output period within [start_ns, end_ns], ns."""
    first, last = int(np.ceil(start_ns * hz / NS_PER_S)), int(end_ns * hz / NS_PER_S)
    t_ns: I64 = (np.arange(first, last + 1) * (NS_PER_S / hz)).astype(np.int64)
    return t_ns[(t_ns >= start_ns) & (t_ns <= end_ns)]


def _gyro(front_end: FrontEnd) -> tuple[I64, F64]:
    samples = [m for m in front_end.messages if isinstance(m, ImuSamples)]
    return np.concatenate([m.sample_t_ns for m in samples]), np.concatenate([m.gyro for m in samples])


def _velocities(t_ns: I64, v_B: F64) -> list[Velocity]:
    return [_velocity(k, int(t), v, NO_COVARIANCE) for k, (t, v) in enumerate(zip(t_ns, v_B, strict=True))]


def _velocity(seq: int, t_ns: int, v_B: F64, cov: F64) -> Velocity:
    return Velocity(seq, t_ns, v_B, cov, True, TrackingState.TRACKING, "", seq, t_ns)
