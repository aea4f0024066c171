"""What is measured of the optimizer: cases of ``velod bench``."""

from __future__ import annotations

from itertools import count

import numpy as np

from velod.config import Settings
from velod.eval import bench_input
from velod.eval.bench import Case, Size
from velod.eval.bench_input import RIG
from velod.optimizer.batch_fit import Fit, solve
from velod.optimizer.bins import compress
from velod.optimizer.estimator import Estimator
from velod.optimizer.flow_equation import Rows, body_rows, on_velocity
from velod.optimizer.interval import BLOCK
from velod.optimizer.stage import OptimizerStage
from velod.optimizer.window import Window
from velod.types import (
    F64,
    NS_PER_S,
    DepthBatch,
    FlowBatch,
    Odometry,
)
from velod.wire import encode

_V_AND_BW = [0, 1, 2, 6, 7, 8]
"""Of Window.selector's rows: spline and gyroscope bias."""


def window(size: Size) -> Case:
    """``solve.window``: a batch taken in by a full window, all in.

    Rows, fit, compression, inertial factors, solution and covariance; against normal equations of all rows of the
    window by dense numpy, which lack the IMU.
    """
    warm = size.window + size.window // 4
    stream = list(bench_input.estimates(warm + size.repeats + 1, size.flows, seed=3))
    # The peer stays in the window at which ``run`` begins.
    still, estimator = Estimator(Settings(), RIG), Estimator(Settings(), RIG)
    for imu, flow, depth in stream[:warm]:
        for e in (still, estimator):
            e.add_imu(imu)
            e.absorb(flow, depth)
    batches = [_rows(flow, depth) for _, flow, depth in stream[warm - size.window : warm]]
    ahead = iter(stream[warm:])

    def run() -> None:
        imu, flow, depth = next(ahead)
        estimator.add_imu(imu)
        estimator.absorb(flow, depth)

    def run_peer() -> tuple[F64, F64]:
        H, h = dense_normal_equations(still.window, batches)
        # The IMU's factors, which determine the other states, cost the peer nothing.
        H[np.diag_indices_from(H)] += 1.0
        cov: F64 = np.asarray(np.linalg.inv(H), np.float64)
        return cov @ h, cov[-BLOCK:, -BLOCK:]

    def disagreement() -> float:
        """Of one batch's information, relative: compression takes the spline as constant over 5 ms."""
        rows, fit = batches[-1]
        H, _ = dense_normal_equations(still.window, batches[-1:])
        compressed = np.zeros_like(H)
        bins = compress(rows, np.zeros((len(rows.z), 3)), fit, 1.0, np.zeros(3))
        for t_ns, L in zip(bins.t_ns, bins.L, strict=True):
            at = still.window.selector(t_ns)[_V_AND_BW]
            compressed += at.T @ L[:6, :6] @ at
        return float(np.abs(compressed - H).max() / np.abs(H).max())

    return Case("solve.window", run, 1, "dense numpy of all rows", run_peer, 1, disagreement, slow=True)


def _rows(flow: FlowBatch, depth: DepthBatch) -> tuple[Rows, Fit]:
    """A batch of ``bench_input.estimates`` as rows on v_B with robust weights; camera and IMU are one."""
    camera = (RIG.left.fx, RIG.left.cx, RIG.left.cy)
    a_B, b_B = body_rows((flow.x, flow.y), flow.n, depth.inv_depth, camera, np.eye(3), np.zeros(3))
    t_ns = flow.t_ns - flow.age.astype(np.int64)
    rows = on_velocity(t_ns, flow.speed.astype(np.float64), a_B, b_B, np.zeros_like(b_B))
    rows.sigma[:] = flow.sigma
    fit = solve(rows, Settings().optimizer.ransac_iterations, seed=1)
    assert fit is not None, "the rows of the made-up input determine a velocity"
    return rows, fit


def dense_normal_equations(states: Window, batches: list[tuple[Rows, Fit]]) -> tuple[F64, F64]:
    """H (n, n) and h (n,) of all rows on the states of the window, one row of J (m, n) per flow."""
    t_ns, z, a, b = (np.concatenate([getattr(r, name) for r, _ in batches]) for name in ("t_ns", "z", "a", "b"))
    w = np.concatenate([fit.weight / (rows.sigma * fit.scale) ** 2 for rows, fit in batches])
    knot_ns = int(Settings().optimizer.knot_s * NS_PER_S)
    segment = t_ns // knot_ns
    J = np.zeros((len(z), states.size))
    for k in range(states.first, states.last + 1):
        here = np.flatnonzero(segment == k)
        weights = _basis((t_ns[here] - k * knot_ns) / knot_ns)
        for column, weight in zip(states.control_columns(k), weights, strict=True):
            J[here, column : column + 3] = weight[:, None] * a[here]
        J[np.ix_(here, states.bias_columns(k)[3:])] = -b[here]
    weighted = J * w[:, None]
    return weighted.T @ J, weighted.T @ z


def _basis(u: F64) -> F64:
    """The four weights of Eq. 7, each (m,)."""
    return np.stack([(1 - u) ** 3, 4 - 6 * u**2 + 3 * u**3, 1 + 3 * u + 3 * u**2 - 3 * u**3, u**3]) / 6.0


def imu_rate(size: Size) -> Case:
    """``output.imu_rate``: all that a velocity between two batches costs the stage, as bytes.

    It is carried there by the IMU, with covariance, attitude, judgement and dead reckoning.
    """
    stage = OptimizerStage(Settings(), RIG)
    stream = list(bench_input.estimates(size.window, size.flows, seed=3))
    out = [answer for batch in stream for message in batch for answer in stage.handle(message)]
    assert isinstance(out[-1], Odometry), "the made-up input ends with a valid velocity"
    # Another moment each time, as the estimator remembers what it has predicted.
    later_ns = count(stream[-1][1].t_ns + 5_000_000, 1_000)

    def run() -> list[bytes]:
        return [encode(answer, 1) for answer in stage.put_out(next(later_ns))]

    return Case("output.imu_rate", run)
