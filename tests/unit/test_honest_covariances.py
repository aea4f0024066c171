"""Errors against the covariances that are published with them, over noises and motions that nothing was set on."""

import numpy as np
import pytest

from tests.synthetic import CALIBRATION, FLIGHT, SPIN, messages
from velod.config import Settings
from velod.optimizer.dead_reckoning import upright
from velod.optimizer.stage import OptimizerStage
from velod.types import Odometry, Velocity

SEEDS, SECONDS = range(4), 1.2
THREE_SIGMA = 14.16
"""Of the squared distance in three dimensions: 99.7 %."""


def squared_distances(errors, covs):
    return np.array([e @ np.linalg.solve(cov, e) for e, cov in zip(errors, covs, strict=True)])


def run(motion, seed, kind):
    stage = OptimizerStage(Settings(), CALIBRATION)
    return [v for m in messages(motion, SECONDS, seed=seed) for v in stage.handle(m) if isinstance(v, kind)]


@pytest.mark.parametrize("motion", [FLIGHT, SPIN])
def test_velocities_err_as_their_covariances_say(motion):
    """These flows share no error, for which covariances leave room: they are too large here."""
    valid = [v for seed in SEEDS for v in run(motion, seed, Velocity) if v.valid]
    nees = squared_distances([v.v_B - motion.v_B(v.t_ns * 1e-9) for v in valid], [v.cov for v in valid])
    assert len(nees) > 250
    assert 0.6 < nees.mean() < 3.0
    assert np.mean(nees < THREE_SIGMA) > 0.98


def test_dead_reckoning_errs_by_less_than_a_hundredth_of_the_way_and_as_its_covariance_says():
    """Against the true way, in the frame that begins upright with heading zero, as the reckoning's does.

    The rig begins tilted by 68 degrees, where up says little of the heading: that is in the covariance alone.
    """
    at_end = []
    for seed in SEEDS:
        last = run(FLIGHT, seed, Odometry)[-1]
        t = np.linspace(last.origin_t_ns, last.t_ns, 2000) * 1e-9
        v_W = np.array([FLIGHT.R_WB(x) @ FLIGHT.v_B(x) for x in t])
        way_W = np.trapezoid(v_W, t, axis=0)
        R_WB = FLIGHT.R_WB(t[0])
        way_O = upright(np.eye(3), R_WB.T @ [0.0, 0.0, 9.81]) @ R_WB.T @ way_W
        at_end.append((last.p_OB - way_O, last.cov))
        along, up = np.linalg.norm(last.p_OB[:2]) - np.linalg.norm(way_O[:2]), last.p_OB[2] - way_O[2]
        assert np.hypot(along, up) < 0.01 * last.distance_m
        assert abs(last.distance_m / np.trapezoid(np.linalg.norm(v_W, axis=1), t) - 1.0) < 0.01
    assert squared_distances(*zip(*at_end, strict=True)).mean() < 6.0
