"""Roll and pitch: the direction of gravity in B and its covariance."""

import numpy as np
import pytest

from tests.synthetic import CALIBRATION, FLIGHT, SPIN, messages
from velod.config import from_tree
from velod.geometry.so3 import exp
from velod.optimizer import attitude
from velod.optimizer.preintegration import preintegrate
from velod.optimizer.stage import OptimizerStage
from velod.types import Velocity


def estimates(motion, seconds, seed=0):
    stage = OptimizerStage(from_tree({}), CALIBRATION)
    out = [v for m in messages(motion, seconds, seed=seed) for v in stage.handle(m)]
    return [v for v in out if isinstance(v, Velocity) and np.isfinite(v.up_B).all()]


def tilt_nees(v, motion):
    """(error of up)^T cov^-1 (error of up) in the two directions across up."""
    up = motion.R_WB(v.t_ns * 1e-9).T @ [0.0, 0.0, 1.0]
    across = np.linalg.svd(v.up_B[None])[2][1:]  # (2, 3), orthonormal to up_B
    d = across @ (up - v.up_B)
    return d @ np.linalg.solve(across @ v.up_cov @ across.T, d)


@pytest.mark.parametrize("motion", [FLIGHT, SPIN])
def test_up_is_found_and_its_covariance_is_honest(motion):
    nees = []
    for seed in range(4):
        found = estimates(motion, 1.5, seed)
        assert found[0].t_ns < 0.5e9
        for v in found:
            assert np.linalg.norm(v.up_B) == pytest.approx(1.0)
        nees += [tilt_nees(v, motion) for v in found]
    # 2 degrees of freedom; noise that flows do not share makes the information shared_error times too small
    assert 0.2 < np.mean(nees) < 3.0


def test_the_covariance_of_up_has_rank_two_and_shrinks_with_time():
    found = estimates(FLIGHT, 1.5)
    for v in found:
        assert abs(v.up_B @ v.up_cov @ v.up_B) < 1e-9 * np.trace(v.up_cov)
        assert np.allclose(v.up_cov, v.up_cov.T)
    assert np.trace(found[-1].up_cov) < 0.5 * np.trace(found[0].up_cov)


def test_up_is_not_known_before_the_first_velocity():
    stage = OptimizerStage(from_tree({}), CALIBRATION)
    out = [v for m in messages(FLIGHT, 0.3, dark=(0.0, 0.3)) for v in stage.handle(m)]
    assert out and all(np.isnan(v.up_B).all() and np.isnan(v.up_cov).all() for v in out)


def test_the_jacobian_of_up_is_central_differences():
    rng = np.random.default_rng(5)
    t_ns = np.arange(0, 60_000_001, 5_000_000)
    accel, gyro = rng.normal(size=(len(t_ns), 3)) * 10, rng.normal(size=(len(t_ns), 3)) * 8
    R_LB, g_L, b_w = exp(rng.normal(size=3)), np.array([3.0, -8.0, 4.0]), np.array([0.02, -0.01, 0.03])

    def up(x):
        p = preintegrate(t_ns, accel, gyro, 2_000_000, 57_000_000, np.zeros(3), x[:3], 1e-2, 1e-3)
        return (R_LB @ p.R_gamma).T @ x[3:] / np.linalg.norm(x[3:]), p

    x, h = np.concatenate([b_w, g_L]), 1e-5
    up_B, p = up(x)
    J = attitude.up_jacobian(p, R_LB @ p.R_gamma, up_B, float(np.linalg.norm(g_L)))
    for i, unit in enumerate(np.eye(6)):
        numeric = (up(x + h * unit)[0] - up(x - h * unit)[0]) / (2 * h)
        assert np.allclose(J[:, i], numeric, atol=1e-7)


def test_a_rotated_frame_is_carried_by_the_gyroscope():
    """Gravity is fixed in L: what turns up in B is the rotation of B alone."""
    t_ns, gyro = np.arange(0, 100_000_001, 5_000_000), np.array([0.0, 0.0, 5.0])
    p = preintegrate(
        t_ns, np.zeros((21, 3)), np.tile(gyro, (21, 1)), 0, 100_000_000, np.zeros(3), np.zeros(3), 1e-2, 1e-3
    )
    carried = attitude.carry(p, np.eye(3), np.array([9.81, 0.0, 0.0]), np.eye(6) * 1e-6)
    assert np.allclose(carried.R_LB, exp(gyro * 0.1), atol=1e-12)
    assert np.allclose(carried.up_B, [np.cos(0.5), -np.sin(0.5), 0.0], atol=1e-12)
