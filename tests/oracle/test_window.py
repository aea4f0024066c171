"""The sliding window against the full batch solution, and its factors against central differences."""

from dataclasses import replace

import numpy as np
import pyceres
import pytest
from scipy.optimize import least_squares

from tests.synthetic import CALIBRATION, FLIGHT, Motion, messages
from velod.config import ImuSettings, Settings, from_tree
from velod.geometry.so3 import exp, hat
from velod.optimizer.bins import BIN_NS
from velod.optimizer.estimator import Estimator
from velod.optimizer.head import Head
from velod.optimizer.interval import BLOCK, HEAD, Interval
from velod.optimizer.preintegration import preintegrate
from velod.optimizer.stage import OptimizerStage
from velod.optimizer.window import Window
from velod.types import ImuSamples, Velocity

KNOT_NS = 100_000_000
COMMON_SIGMA = np.array([0.004, 0.001, 0.003])


def moment(t_ns, L, eta):
    """An interval of one bin, of which the IMU says nothing: flows at ``t_ns``."""
    interval = Interval(t_ns // BIN_NS * BIN_NS, t_ns // BIN_NS * BIN_NS + BIN_NS)
    interval.flows.L[0], interval.flows.eta[0], interval.flows.total[0] = L, eta, (2.0, 2.0 * (t_ns % BIN_NS))
    return interval


def across_a_knot(window, rng):
    """An interval of seven bins, some of them without flows, that begins in the last segment but one."""
    knot = window.last * KNOT_NS
    interval = Interval(knot - 13_000_000, knot + 17_000_000)
    interval.until = interval.t_j
    interval.blocks[:], interval.r[:] = rng.normal(size=(3, 15)), rng.normal(size=3)
    root = rng.normal(size=(3, 3))
    interval.information[:] = root @ root.T + np.eye(3)
    interval.noise[:] = rng.normal(size=interval.noise.shape)
    for k in (0, 2, 3, 5):
        J = rng.normal(size=(12, 9)) * 30.0
        interval.flows.L[k], interval.flows.eta[k] = J.T @ J, J.T @ rng.normal(size=12)
        interval.flows.total[k] = 3.0, 3.0 * rng.uniform(0, BIN_NS)
    return interval


def dense_twin(window, interval):
    """J^T J and J^T r of an interval on the states of the window, by dense algebra with the noise as states."""
    noises = np.eye(interval.noise.shape[1])
    n, m = window.size, len(noises)
    J = interval.blocks[:, :12] @ window.selector(interval.t_i)
    J = np.hstack([J + interval.blocks[:, 12:] @ window.spline_row(interval.until), interval.noise])
    H, h = J.T @ interval.information @ J, J.T @ interval.information @ interval.r
    H[n:, n:] += noises * (BIN_NS * 1e-9 / ImuSettings().gyro_noise ** 2)
    for k in range(interval.flows.count):
        weight, weighted_ns = interval.flows.total[k]
        if weight:
            t = (interval.flows.first + k) * BIN_NS + int(weighted_ns / weight)
            common = np.eye(n)[window.common_columns(t // KNOT_NS)]
            F = np.hstack([np.vstack([window.selector(t)[[0, 1, 2, 6, 7, 8]], common]), np.zeros((9, m))])
            F[3:6, n:] = noises[3 * k : 3 * k + 3]
            H += F.T @ interval.flows.L[k] @ F
            h += F.T @ interval.flows.eta[k]
    gain = np.linalg.solve(H[n:, n:], np.column_stack([H[n:, :n], h[n:]]))
    return H[:n, :n] - H[:n, n:] @ gain[:, :-1], h[:n] - H[:n, n:] @ gain[:, -1]


def filled(segments, rng, bias_margins=(1.0, 1.0)):
    """A window that has lived through 12 segments with the same random factors, keeping ``segments`` of them."""
    w = Window(ImuSettings(), KNOT_NS, segments, 0.5, COMMON_SIGMA, bias_margins)
    w.start(0, np.array([1.0, -9.0, 3.0]))
    for k in range(12):
        if k:
            w.extend(exp(rng.normal(size=3)) * 0.1, rng.normal(size=3) * 10, rng.normal(size=3) * 0.01, 0.1)
        for _ in range(4):
            J = rng.normal(size=(8, 9))
            w.add_interval(moment(int((k + rng.uniform(0, 1)) * KNOT_NS), J.T @ J, J.T @ rng.normal(size=8)))
    return w


def test_marginalisation_equals_the_full_batch_solution():
    whole, sliding = filled(12, np.random.default_rng(5)), filled(4, np.random.default_rng(5))
    x, y = whole.solve([], None, 0.0), sliding.solve([], None, 0.0)
    t = int(11.7 * KNOT_NS)
    assert sliding.size < whole.size
    assert np.allclose(whole.selector(t) @ x.x, sliding.selector(t) @ y.x, atol=1e-6)
    P, Q = x.cov(whole.selector(t)), y.cov(sliding.selector(t))
    assert np.abs((P - Q) / np.sqrt(np.outer(np.diag(P), np.diag(P)))).max() < 1e-4


def test_a_prior_that_is_widened_later_was_as_wide_from_the_start():
    late, early = (filled(12, np.random.default_rng(5), margins) for margins in ((1.0, 1.0), (4.0, 9.0)))
    late.solve([], None, 0.0)
    assert late.holds_start and not filled(4, np.random.default_rng(5)).holds_start
    late.widen_bias_prior((4.0, 9.0))
    x, y = late.solve([], None, 0.0), early.solve([], None, 0.0)
    F = early.selector(int(11.7 * KNOT_NS))
    assert np.allclose(F @ x.x, F @ y.x, atol=1e-9)
    assert np.allclose(x.cov(F), y.cov(F), rtol=1e-6, atol=1e-12)


def dense(window):
    """A copy of the information matrix and vector."""
    n = window.size
    return window._H[:n, :n].copy(), window._h[:n].copy()


@pytest.mark.parametrize("segments", [4, 11])
def test_the_solution_in_the_envelope_is_that_of_dense_algebra(segments):
    rng = np.random.default_rng(3)
    w = filled(segments, rng)
    H, h = dense(w)
    interval, g = across_a_knot(w, rng), np.array([1.0, -9.0, 3.0])
    solution = w.solve([interval], g, 0.01)
    more, more_h = dense_twin(w, interval)
    H, h = H + more, h + more_h
    direction, sigma = g / np.linalg.norm(g), 0.02 + 9.81 * 0.01**2
    newest = w.gravity_columns(w.last)
    H[np.ix_(newest, newest)] += np.outer(direction, direction) / sigma**2
    h[newest] += direction * 9.81 / sigma**2
    P = np.linalg.inv(H)
    assert np.abs((solution.x - P @ h) / np.sqrt(np.diag(P))).max() < 1e-5
    F = w.selector(int((w.last + 0.6) * KNOT_NS))
    Q = F @ P @ F.T
    assert np.abs((solution.cov(F) - Q) / np.sqrt(np.outer(np.diag(Q), np.diag(Q)))).max() < 1e-5


def test_eliminating_the_old_states_once_changes_no_solution():
    """Solutions between factors that come in time, late, and with a new segment, against dense algebra each time."""
    rng = np.random.default_rng(21)
    w, fronts = filled(8, rng), []

    def check(t_ns):
        interval = Interval(t_ns, t_ns + 20_000_000)
        interval.information[:], interval.until = np.eye(3), interval.t_j
        interval.blocks[:], interval.r[:] = rng.normal(size=(3, 15)), rng.normal(size=3)
        H, h = dense(w)
        more, more_h = dense_twin(w, interval)
        P = np.linalg.inv(H + more)
        apart = w.solve([interval], None, 0.0).x - P @ (h + more_h)
        assert np.abs(apart / np.sqrt(np.diag(P))).max() < 1e-5
        fronts.append(w._front)

    newest = int((w.last + 0.3) * KNOT_NS)
    check(newest)
    J = rng.normal(size=(8, 9))
    w.add_interval(moment(newest + 7_000_000, J.T @ J, J.T @ rng.normal(size=8)))
    assert w._front == fronts[0] > 0, "what comes in time leaves the front as it is"
    check(newest)
    w.add_interval(moment(newest - 4 * KNOT_NS, J.T @ J, J.T @ rng.normal(size=8)))
    check(newest)
    w.extend(exp(rng.normal(size=3)) * 0.1, rng.normal(size=3) * 10, np.zeros(3), 0.1)
    check(newest + KNOT_NS)


def test_an_information_that_determines_nothing_is_refused():
    w = filled(4, np.random.default_rng(1))
    w._H[:] = 0.0
    with pytest.raises(np.linalg.LinAlgError):
        w.solve([], None, 0.0)


def test_what_leaves_the_window_is_a_schur_complement():
    w = filled(4, np.random.default_rng(6))
    H, h = dense(w)
    gone = np.r_[0:3, HEAD + 3 : HEAD + BLOCK]
    kept = np.setdiff1d(np.arange(w.size), gone)
    gain = np.linalg.solve(H[np.ix_(gone, gone)], np.column_stack([H[np.ix_(gone, kept)], h[gone]]))
    w._marginalise_oldest()
    m = len(kept)
    assert w.first == 9
    assert np.allclose(w._H[:m, :m], H[np.ix_(kept, kept)] - H[np.ix_(kept, gone)] @ gain[:, :-1], atol=1e-6)
    assert np.allclose(w._h[:m], h[kept] - H[np.ix_(kept, gone)] @ gain[:, -1], atol=1e-6)
    assert not w._H[m:].any() and not w._H[:, m:].any()


def test_a_factor_adds_its_normal_equations():
    rng = np.random.default_rng(9)
    w = filled(4, rng)
    H, h = dense(w)
    J, r, root = (
        rng.normal(size=(3, w.size)) * (rng.random(w.size) < 0.3),
        rng.normal(size=3),
        rng.normal(size=(3, 3)),
    )
    information = root @ root.T
    w.add(J, r, information)
    assert np.allclose(dense(w)[0], H + J.T @ information @ J)
    assert np.allclose(dense(w)[1], h + J.T @ information @ r)


def test_an_interval_adds_imu_and_flows_with_their_noise_marginalised_as_dense_algebra_does():
    rng = np.random.default_rng(9)
    w = filled(4, rng)
    H, h = dense(w)
    interval = across_a_knot(w, rng)
    more, more_h = dense_twin(w, interval)
    w.add_interval(interval)
    scale = np.abs(more).max()
    assert np.allclose(dense(w)[0] - H, more, atol=1e-9 * scale)
    assert np.allclose(dense(w)[1] - h, more_h, atol=1e-9 * scale)


@pytest.fixture
def whole_cost():
    """A window's solution; residuals of all rows one by one, in its states and the noise of every bin; A; n states.

    Weights are fixed, nothing is compressed or marginalised; the residuals are A z - residuals(0).
    """
    rng = np.random.default_rng(12)
    w = filled(4, rng)
    H, h = dense(w)
    root = np.linalg.cholesky(H)
    interval, n = across_a_knot(w, rng), w.size
    noise_sigma = ImuSettings().gyro_noise / (BIN_NS * 1e-9) ** 0.5
    flows = []
    for k in (0, 2, 3, 5):
        J, y = rng.normal(size=(12, 9)) * 30.0, rng.normal(size=12)
        interval.flows.L[k], interval.flows.eta[k] = J.T @ J, J.T @ y
        flows.append((k, interval.flows.t_ns[k], J, y))

    def residuals(z):
        x, noise = z[:n], z[n:]
        imu = interval.blocks[:, :12] @ (w.selector(interval.t_i) @ x)
        imu += interval.blocks[:, 12:] @ (w.spline_row(interval.until) @ x) + interval.noise @ noise - interval.r
        parts = [root.T @ x - np.linalg.solve(root, h), np.linalg.cholesky(interval.information).T @ imu]
        for k, t, J, y in flows:
            state = w.selector(t) @ x
            turned = state[6:9] + noise[3 * k : 3 * k + 3]
            parts.append(J @ np.concatenate([state[:3], turned, x[w.common_columns(t // KNOT_NS)]]) - y)
        return np.concatenate([*parts, noise / noise_sigma])

    zero = np.zeros(n + interval.noise.shape[1])
    A = np.column_stack([residuals(unit) - residuals(zero) for unit in np.eye(len(zero))])
    return w.solve([interval], None, 0.0).x.copy(), residuals, A, n


def in_sigmas(difference, A, n):
    return np.abs(difference / np.sqrt(np.diag(np.linalg.inv(A.T @ A)))[:n]).max()


def test_scipy_reaches_the_same_minimum_of_the_same_cost(whole_cost):
    ours, residuals, A, n = whole_cost
    zero = np.zeros(A.shape[1])
    peer = least_squares(residuals, zero, jac=lambda _: A, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert in_sigmas(ours - peer.x[:n], A, n) < 1e-6


def test_ceres_reaches_the_same_minimum_of_the_same_cost(whole_cost):
    ours, residuals, A, n = whole_cost

    class Cost(pyceres.CostFunction):
        def __init__(self):
            super().__init__()
            self.set_num_residuals(A.shape[0])
            self.set_parameter_block_sizes([A.shape[1]])

        def Evaluate(self, parameters, out, jacobians):
            out[:] = residuals(np.asarray(parameters[0]))
            if jacobians is not None:
                jacobians[0][:] = A.ravel()
            return True

    z, problem, options = np.zeros(A.shape[1]), pyceres.Problem(), pyceres.SolverOptions()
    cost = Cost()
    problem.add_residual_block(cost, None, [z])
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_QR
    options.max_num_iterations = 200
    options.function_tolerance = options.gradient_tolerance = options.parameter_tolerance = 1e-16
    pyceres.solve(options, problem, pyceres.SolverSummary())
    assert in_sigmas(ours - z[:n], A, n) < 1e-6


def test_both_splines_tell_the_same_of_a_motion_that_both_can_represent():
    """Without rotation and with a velocity that is smooth at the knots' distance, from sensors without noise."""
    glide = Motion(np.zeros(3), np.array([2.0, 1.0, 0.3]), np.array([0.5, -0.4, 0.3]), np.array([1.0, 0.8, 1.2]))

    def velocities(spline):
        stage = OptimizerStage(from_tree({"optimizer": {"spline": spline}}), CALIBRATION)
        stream = messages(glide, 1.2, noise=0.0, outliers=0.0)
        return [v for m in stream for v in stage.handle(m) if isinstance(v, Velocity)]

    pairs = [(a, b) for a, b in zip(velocities("error"), velocities("velocity"), strict=True) if a.valid and b.valid]
    assert len(pairs) > 70
    apart = np.array([np.linalg.norm(a.v_B - b.v_B) for a, b in pairs])
    assert apart.max() < 4e-3 and apart.mean() < 1e-3


def test_the_window_keeps_its_size():
    w = filled(4, np.random.default_rng(1))
    assert (w.first, w.last) == (8, 11)
    assert w.size == HEAD + 4 * BLOCK
    assert w.contains(8 * KNOT_NS)
    assert not w.contains(8 * KNOT_NS - 1)


def test_gravity_turns_in_L_as_the_error_of_the_gyroscope_says():
    """d g_L / dt = [R_LB (b_w - b_used)]x g_L: the sign that Window.extend relies on, from exact rotations."""
    rng = np.random.default_rng(2)
    w, error, g_W = rng.normal(size=3), rng.normal(size=3) * 1e-3, np.array([0.0, 0.0, 9.81])
    dt, R_LB, R_WB = 1e-4, np.eye(3), exp(rng.normal(size=3))
    start = R_LB @ R_WB.T @ g_W
    D_L = np.zeros((3, 3))
    for _ in range(1000):
        D_L += R_LB @ exp(0.5 * dt * w) * dt
        R_LB = R_LB @ exp(dt * w)  # what the gyroscope says, less the bias that was used
        R_WB = R_WB @ exp(dt * (w - error))  # the truth: b_w - b_used = error
    change = R_LB @ R_WB.T @ g_W - start
    assert np.linalg.norm(change) > 1e-4
    assert np.allclose(change, np.cross(D_L @ error, start), atol=2e-2 * np.linalg.norm(change))


@pytest.fixture(params=["error", "velocity"])
def estimator(request):
    """With 0.6 s of tumbling IMU samples, a window over them and a head with biases."""
    settings = Settings()
    object.__setattr__(settings.optimizer, "spline", request.param)
    e = Estimator(settings, CALIBRATION)
    rng = np.random.default_rng(7)
    t = np.arange(121) * 5_000_000
    w = 4 * np.sin(t[:, None] * 1e-9 * np.array([9.0, 7.0, 11.0])) + rng.normal(size=3)
    a = 15 * np.cos(t[:, None] * 1e-9 * np.array([5.0, 8.0, 6.0])) + rng.normal(size=3)
    e.add_imu(ImuSamples(0, int(t[-1]), 0, -1, 0, t, a, w))
    e.memory.integrate_to(600_000_000, np.zeros(3), np.zeros(3))
    e._start(0, 20_000_000)
    e._extend_to(250_000_000)
    b_a, b_w = np.array([0.1, -0.2, 0.15]), np.array([0.02, -0.03, 0.01])
    R_LB = e.memory.at(np.array([250_000_000]))[0][0]
    g_L = np.array([1.0, -9.0, 3.0])
    v_B, s_L = np.array([3.0, -1.0, 2.0]), e.memory.at(np.array([250_000_000]))[1][0]
    e.head = Head(
        250_000_000, v_B, b_a, b_w, g_L, R_LB, np.eye(12) * 1e-4, np.zeros(3), np.eye(3) * 1e-6, R_LB @ v_B - s_L
    )
    return e


def linearised(e, t_i, t_j):
    interval = Interval(t_i, t_j)
    e._linearise(interval, t_j)
    return interval


def residual(e, x, t_i, t_j):
    """Eq. 14's inertial residual, exact in the states x of the window."""
    w = e.window
    _, N_i, M_i = e._frame(t_i)
    _, N_j, M_j = e._frame(t_j)
    c, b_a, b_w, g_L = np.split(w.selector(t_i) @ x, [3, 6, 9])
    m = e.memory
    p = preintegrate(m.t_ns, m.accel, m.gyro, t_i, t_j, b_a, b_w, 1.0, 1.0)
    g_B = e._frame(t_i)[0].T @ g_L
    v_i, v_j = N_i + M_i @ c, N_j + M_j @ (w.spline_row(t_j) @ x)
    return p.beta - p.R_gamma @ v_j - g_B * p.dt + v_i


def test_the_inertial_factor_is_the_derivative_of_the_residual(estimator):
    e, (t_i, t_j) = estimator, (255_000_000, 280_000_000)
    interval = linearised(e, t_i, t_j)
    predicted, _ = e.predict(t_j)
    F, G = e.window.selector(t_i), e.window.spline_row(t_j)
    J = interval.blocks[:, :12] @ F + interval.blocks[:, 12:] @ G
    # a state at the factor's linearisation: biases of the head, velocity at t_j as predicted
    _, N_j, M_j = e._frame(t_j)
    x = F[3:6].T @ e.head.b_a + F[6:9].T @ e.head.b_w + F[9:12].T @ e.head.g_L
    x = x + G.T @ np.linalg.solve(G @ G.T, np.linalg.solve(M_j, predicted - N_j))
    assert np.allclose(J @ x - interval.r, residual(e, x, t_i, t_j), atol=1e-9)
    h = 1e-6
    for column in np.flatnonzero(J.any(axis=0)):
        d = np.zeros(len(x))
        d[column] = h
        numeric = (residual(e, x + d, t_i, t_j) - residual(e, x - d, t_i, t_j)) / (2 * h)
        assert np.allclose(J[:, column], numeric, atol=1e-6), column
    assert np.all(np.linalg.eigvalsh(interval.information) > 0)


def test_a_noise_that_lasts_is_a_bias(estimator):
    """Equal in all bins, the gyroscope's noise does to the residual what b_w does."""
    interval = linearised(estimator, 255_000_000, 280_000_000)
    total = interval.noise.reshape(3, -1, 3).sum(axis=1)
    assert np.allclose(total, interval.blocks[:, 6:9], atol=0.01 * np.abs(total).max())


def test_without_flows_an_interval_weighs_what_the_imus_noise_leaves(estimator):
    e, (t_i, t_j) = estimator, (255_000_000, 280_000_000)
    interval = linearised(e, t_i, t_j)
    p, (v_j, _) = e._preintegrate(t_i, t_j, e.head.b_a, e.head.b_w), e.predict(t_j)
    G = np.hstack([p.R_gamma @ hat(v_j), np.eye(3)])
    covariance = G @ p.cov @ G.T + np.eye(3) * 1e-6
    noise = interval.noise @ interval.noise.T * (Settings().imu.gyro_noise ** 2 / (BIN_NS * 1e-9))
    assert np.allclose(np.linalg.inv(interval.information) + noise, covariance, atol=0.02 * np.abs(covariance).max())


def test_the_velocity_is_carried_by_eq_10(estimator):
    e, t = estimator, 290_000_000
    head = e.head
    p = e._preintegrate(head.t_ns, t, head.b_a, head.b_w)
    v, _ = e.predict(t)
    assert np.allclose(v, p.R_gamma.T @ (p.beta + head.v_B - head.R_LB.T @ head.g_L * p.dt), atol=1e-13)


def test_the_inertial_residual_closes_on_the_true_motion():
    """Eq. 10 with beta rotated by R_WB_i: exact motion leaves no residual."""
    w_B, a_W, g_W = np.array([0.5, -2.0, 3.0]), np.array([2.0, -1.0, 4.0]), np.array([0.0, 0.0, 9.81])
    t = np.arange(31) * 1_000_000
    R_WB = [exp(w_B * ti * 1e-9) for ti in t]
    v_B = [R.T @ (np.array([5.0, 1.0, -2.0]) + a_W * ti * 1e-9) for R, ti in zip(R_WB, t, strict=True)]
    accel = np.array([R.T @ (a_W + g_W) for R in R_WB])
    p = preintegrate(t, accel, np.tile(w_B, (31, 1)), 0, int(t[-1]), np.zeros(3), np.zeros(3), 1.0, 1.0)
    r = p.beta - p.R_gamma @ v_B[-1] - R_WB[0].T @ g_W * p.dt + v_B[0]
    assert np.linalg.norm(r) < 1e-6


def test_the_covariance_carried_by_the_imu_is_that_of_its_jacobian(estimator):
    e, t = estimator, 290_000_000
    v, cov = e.predict(t)
    head, h = e.head, 1e-6
    J = np.zeros((3, 12))
    start = np.concatenate([head.v_B, head.b_a, head.b_w, head.g_L])
    for i in range(12):
        sides = []
        for sign in (1, -1):
            x = start.copy()
            x[i] += sign * h
            e.head = replace(head, v_B=x[:3], b_a=x[3:6], b_w=x[6:9], g_L=x[9:])
            sides.append(e.predict(t)[0])
        J[:, i] = (sides[0] - sides[1]) / (2 * h)
    from_head = J @ head.cov @ J.T
    p = preintegrate(e.memory.t_ns, e.memory.accel, e.memory.gyro, head.t_ns, t, head.b_a, head.b_w, 1.86e-2, 1.86e-3)
    N = np.hstack([hat(v), p.R_gamma.T])
    assert np.allclose(cov, from_head + N @ p.cov @ N.T, rtol=1e-5, atol=1e-12)


def test_counting_the_spline_from_another_origin_moves_it_and_nothing_else():
    w, t = filled(4, np.random.default_rng(5)), int(11.7 * KNOT_NS)
    F = w.selector(t)
    x = w.solve([], None, 0.0)
    before, P = F @ x.x, x.cov(F)
    w.shift(np.array([300.0, -20.0, 5.0]), np.zeros(3))
    y = w.solve([], None, 0.0)
    assert np.allclose((F @ y.x)[:3] - before[:3], [300.0, -20.0, 5.0], atol=1e-6)
    assert np.allclose((F @ y.x)[3:], before[3:], atol=1e-5)
    assert np.allclose(y.cov(F), P)


def test_common_errors_counted_from_another_origin_move_and_nothing_else():
    """A delay that is taken out of the stamps: flows of the window say the same of what is left of it."""
    w, t = filled(4, np.random.default_rng(5)), int(11.7 * KNOT_NS)
    F, own = w.selector(t), w.common_columns(w.last)
    x = w.solve([], None, 0.0).x.copy()
    w.shift(np.zeros(3), np.array([0.0, -0.003, 0.0]))
    y = w.solve([], None, 0.0).x
    assert np.allclose(y[own] - x[own], [0.0, -0.003, 0.0], atol=1e-9)
    assert np.allclose(F @ y, F @ x, atol=1e-5)


def test_a_common_error_that_begins_anew_owes_nothing_to_those_before():
    w = filled(4, np.random.default_rng(5))
    w.begin_common_anew(1)
    w.extend(np.eye(3) * 0.1, np.array([1.0, -9.0, 3.0]), np.zeros(3), 0.1)
    H, _ = dense(w)
    before, own = w.common_columns(w.last - 1), w.common_columns(w.last)
    assert H[own[1], before[1]] == 0.0 and np.isclose(H[own[1], own[1]], COMMON_SIGMA[1] ** -2)
    assert H[own[0], before[0]] < 0.0 and H[own[2], before[2]] < 0.0


def test_an_estimate_does_not_notice_that_the_integrated_velocity_is_counted_anew(monkeypatch):
    def final(limit):
        monkeypatch.setattr("velod.optimizer.estimator.MAX_INTEGRATED", limit)
        stage = OptimizerStage(from_tree({}), CALIBRATION)
        velocities = [v for m in messages(FLIGHT, 1.0) for v in stage.handle(m) if isinstance(v, Velocity)]
        return np.array([v.v_B for v in velocities]), stage._estimator.memory.at(np.array([velocities[-1].t_ns - 1]))[
            1
        ]

    (often, s_often), (never, s_never) = final(1.0), final(1e9)
    assert np.linalg.norm(s_often) < 2.0 < np.linalg.norm(s_never)
    assert np.abs(often - never).max() < 1e-7
