"""Dead reckoning: one integration of the velocity, kept upright by gravity."""

import numpy as np

from tests.synthetic import CALIBRATION, FLIGHT, messages
from velod.config import from_tree
from velod.geometry.so3 import exp, hat, matrix_from_quaternion, quaternion_from_matrix
from velod.optimizer.dead_reckoning import DeadReckoning, upright
from velod.optimizer.stage import OptimizerStage
from velod.types import Odometry, Velocity


def reckon_flight(reckoning, seconds=2.0, hz=200):
    """The exact flight; the last message and the true way from the start, in O."""
    t = np.arange(int(seconds * hz) + 1) / hz
    for ti in t:
        R_WB = FLIGHT.R_WB(ti)
        out = reckoning.update(int(ti * 1e9), FLIGHT.v_B(ti), np.eye(3) * 1e-4, R_WB, R_WB.T @ [0.0, 0.0, 9.81])
    v_W = np.array([FLIGHT.R_WB(ti) @ FLIGHT.v_B(ti) for ti in t])
    way_W = ((v_W[1:] + v_W[:-1]) / 2 / hz).sum(axis=0)
    R_OW = upright(np.eye(3), FLIGHT.R_WB(0.0).T @ [0.0, 0.0, 9.81]) @ FLIGHT.R_WB(0.0).T
    return out, R_OW @ way_W, R_OW


def plain_step(dt, R_OB, p, P, v_O, v_B, cov, turn, g_B, tilt_cov, tau, gyro_noise):
    """One step of the reckoning in plain matrices."""
    z = np.array([0.0, 0.0, 1.0])
    R = R_OB @ turn
    up = R @ g_B / np.linalg.norm(g_B)
    axis = np.cross(up, z)
    sine = np.linalg.norm(axis)
    R = exp(axis / sine * np.arctan2(sine, up[2])) @ R
    mean = 0.5 * (v_O + R @ v_B)
    F = np.eye(4)
    F[:3, 3] = np.cross(z, mean) * dt
    P = F @ P @ F.T
    turned = hat(mean) @ hat(z) @ R
    P[:3, :3] += (R @ cov @ R.T + turned @ tilt_cov @ turned.T) * (2.0 * tau * dt)
    P[3, 3] += gyro_noise**2 * dt
    return R, p + mean * dt, P, np.linalg.norm(mean) * dt


def test_a_step_is_what_plain_matrices_say():
    rng = np.random.default_rng(4)
    for _ in range(50):
        A = rng.normal(size=(2, 3, 3))
        cov, tilt_cov = 1e-3 * A @ A.transpose(0, 2, 1)
        v, g = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
        R_LB = exp(rng.normal(size=(3, 3)) * 2.0)
        reckoning = DeadReckoning(0.7, 0.3)
        reckoning.update(0, v[0], cov, R_LB[0], g[0], tilt_cov)
        # the second of two steps begins with all of a covariance
        for k, t_ns in ((1, 5_000_000), (2, 12_000_000)):
            dt = (t_ns - reckoning._t_ns) * 1e-9
            before = (reckoning._R_OB.copy(), reckoning._p_O.copy(), reckoning._cov.copy(), reckoning._v_O.copy())
            way, turn = reckoning._distance_m, R_LB[k - 1].T @ R_LB[k]
            out = reckoning.update(t_ns, v[k], cov, R_LB[k], g[k], tilt_cov)
            R, p, P, step = plain_step(dt, *before, v[k], cov, turn, g[k], tilt_cov, 0.7, 0.3)
            assert np.allclose(reckoning._cov, P, rtol=1e-12, atol=1e-14)
            assert np.allclose(out.p_OB, p, rtol=1e-12, atol=1e-14)
            assert np.allclose(out.q_OB, quaternion_from_matrix(R), rtol=0, atol=1e-12)
            assert abs(out.distance_m - way - step) < 1e-14


def test_an_exact_velocity_is_integrated_to_the_true_way_and_attitude():
    out, way_O, R_OW = reckon_flight(DeadReckoning(1.0, 1e-3))
    assert np.linalg.norm(way_O) > 3.0
    assert np.linalg.norm(out.p_OB - way_O) < 1e-3
    assert np.allclose(matrix_from_quaternion(out.q_OB), R_OW @ FLIGHT.R_WB(2.0), atol=1e-6)
    assert abs(out.distance_m - np.linalg.norm(way_O)) < 1.0
    assert out.distance_m >= np.linalg.norm(out.p_OB)


def test_upright_puts_gravity_along_z_whatever_the_attitude():
    rng = np.random.default_rng(0)
    for _ in range(20):
        R, g_B = exp(rng.normal(size=3) * 2), rng.normal(size=3)
        assert np.allclose(upright(R, g_B) @ g_B / np.linalg.norm(g_B), [0.0, 0.0, 1.0], atol=1e-12)
    assert np.allclose(upright(np.eye(3), np.array([0.0, 0.0, -9.81])) @ [0.0, 0.0, -1.0], [0.0, 0.0, 1.0])


def test_gravity_takes_out_the_tilt_that_the_gyroscope_gathers():
    reckoning = DeadReckoning(1.0, 1e-3)
    for k in range(1000):
        drift = exp(np.array([2e-3 * k, 0.0, 0.0]))  # the gyroscope says it turns; gravity that it does not
        out = reckoning.update(
            k * 5_000_000, np.array([1.0, 0.0, 0.0]), np.eye(3) * 1e-4, drift, np.array([0, 0, 9.81])
        )
    assert np.allclose(matrix_from_quaternion(out.q_OB), np.eye(3), atol=1e-9)
    assert np.allclose(out.p_OB, [999 * 5e-3, 0.0, 0.0], atol=1e-9)


def test_the_covariance_is_that_of_velocity_errors_that_last():
    """Errors drawn anew every correlation time, on a straight way: the end points scatter as the covariance says."""
    sigma, tau, dt, steps = 0.05, 0.5, 0.01, 1000
    rng, ends = np.random.default_rng(1), []
    for _ in range(200):
        # first-order Gauss-Markov error
        error, decay = rng.normal(size=3) * sigma, np.exp(-dt / tau)
        p = np.zeros(3)
        for _ in range(steps):
            error = decay * error + np.sqrt(1 - decay**2) * sigma * rng.normal(size=3)
            p += error * dt
        ends.append(p)
    reckoning = DeadReckoning(tau, 1e-9)
    for k in range(steps + 1):
        out = reckoning.update(k * 10_000_000, np.zeros(3), np.eye(3) * sigma**2, np.eye(3), np.array([0, 0, 9.81]))
    assert np.allclose(np.sqrt(np.diag(out.cov)), np.std(ends), rtol=0.15)


def test_the_heading_error_grows_across_the_way():
    reckoning = DeadReckoning(1.0, 0.05)
    for k in range(1001):
        out = reckoning.update(
            k * 10_000_000, np.array([2.0, 0.0, 0.0]), np.zeros((3, 3)), np.eye(3), np.array([0, 0, 9.81])
        )
    assert out.cov[1, 1] > 1.0
    assert out.cov[0, 0] < 1e-9


def test_a_tilt_error_turns_the_way_and_its_covariance_says_so():
    """Up known to 0.05 rad while moving along x at 2 m/s: an error of z, of 0.1 m/s for the correlation time."""
    reckoning, tilt = DeadReckoning(1.0, 1e-9), np.diag([0.05**2, 0.05**2, 0.0])
    for k in range(1001):
        out = reckoning.update(
            k * 10_000_000, np.array([2.0, 0.0, 0.0]), np.zeros((3, 3)), np.eye(3), np.array([0, 0, 9.81]), tilt
        )
    assert np.isclose(out.cov[2, 2], 2.0 * 0.1**2 * 10.0, rtol=0.01)
    assert abs(out.cov[0, 0]) < 1e-9


def test_an_origin_with_an_uncertain_up_has_an_uncertain_heading():
    """B lies on its side, up known to 0.1 rad: headings of origins drawn so scatter as the covariance says."""
    rng, up, sigma, headings = np.random.default_rng(4), np.array([0.0, -1.0, 0.0]), 0.1, []
    for _ in range(2000):
        wrong = upright(np.eye(3), up + np.array([1.0, 0.0, 1.0]) * rng.normal(size=3) * sigma)
        forward = (wrong @ upright(np.eye(3), up).T)[:, 0]
        headings.append(np.arctan2(forward[1], forward[0]))
    reckoning = DeadReckoning(1.0, 1e-9)
    tilt = np.diag([sigma**2, 0.0, sigma**2])
    for k in range(101):
        out = reckoning.update(
            k * 10_000_000, np.array([1.0, 0.0, 0.0]), np.zeros((3, 3)), np.eye(3), up, tilt if k == 0 else tilt * 0
        )
    assert np.isclose(np.sqrt(out.cov[1, 1]), np.std(headings) * 1.0, rtol=0.1)


def test_a_reset_begins_a_new_reckoning_at_zero():
    stage = OptimizerStage(from_tree({}), CALIBRATION)
    stream = messages(FLIGHT, 1.5)
    before = [o for m in stream[:200] for o in stage.handle(m) if isinstance(o, Odometry)]
    stage.reset_odometry()
    after = [o for m in stream[200:] for o in stage.handle(m) if isinstance(o, Odometry)]
    assert before[-1].distance_m > 0.5
    assert after[0].origin_t_ns == after[0].t_ns > before[-1].t_ns
    assert not after[0].p_OB.any() and after[0].distance_m == 0.0
    assert after[0].seq == before[-1].seq + 1


def test_a_lost_velocity_begins_a_new_reckoning():
    reckoning = DeadReckoning(1.0, 1e-3)
    reckon_flight(reckoning, 1.0)
    reckoning.stop()
    out = reckoning.update(7_000_000_000, np.ones(3), np.eye(3), np.eye(3), np.array([0.0, 0.0, 9.81]))
    assert out.origin_t_ns == 7_000_000_000
    assert not out.p_OB.any()


def test_every_valid_velocity_of_the_optimizer_comes_with_its_reckoning():
    stage = OptimizerStage(from_tree({}), CALIBRATION)
    out = [v for m in messages(FLIGHT, 1.5) for v in stage.handle(m)]
    valid = [v.t_ns for v in out if isinstance(v, Velocity) and v.valid]
    reckoned = [o for o in out if isinstance(o, Odometry)]
    assert [o.t_ns for o in reckoned] == valid
    first, last = reckoned[0], reckoned[-1]
    times = np.linspace(first.t_ns, last.t_ns, 2000) * 1e-9
    way = np.trapezoid([np.linalg.norm(FLIGHT.v_B(t)) for t in times], times)
    assert abs(last.distance_m / way - 1.0) < 0.02
