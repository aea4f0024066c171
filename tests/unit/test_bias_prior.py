"""The margin on the biases' prior: what the data make likely, and nothing where they say nothing."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from velod.config import ImuSettings
from velod.optimizer.bias_prior import (
    AS_SPECIFIED,
    CHANGED,
    EXCESSIVE,
    IMPLAUSIBLE,
    MARGINS,
    implausible,
    likely_margins,
)

IMU = ImuSettings()
SIGMA = np.repeat([IMU.accel_bias_sigma, IMU.gyro_bias_sigma], 3)
WALKED = (0.01 * SIGMA) ** 2


def data(rng, times, seen=0.5):
    """Covariance (6, 6) and value (6,) of what the data alone say of biases ``times`` as large as specified."""
    mixed = np.diag(SIGMA) @ (np.eye(6) + 0.3 * rng.normal(size=(6, 6))) * seen
    cov = mixed @ mixed.T
    return cov, times * SIGMA * rng.normal(size=6) + mixed @ rng.normal(size=6)


def estimate(cov, value, margins):
    """Biases (6,) and their covariance (6, 6) from data and a prior with ``margins``."""
    prior = (np.repeat(margins, 3) * SIGMA) ** 2 + WALKED
    both = np.linalg.inv(np.linalg.inv(cov) + np.diag(1.0 / prior))
    return both @ np.linalg.solve(cov, value), both


def found(cov, value, margins=(1.0, 1.0)):
    """Margins from the estimate that these data and a prior with ``margins`` make."""
    return likely_margins(*estimate(cov, value, margins), SIGMA, WALKED, margins).margins


def weighted_pairs(cov, value):
    """Every pair of margins with scipy's density of the data: the biases' prior and the data's own noise together."""
    for accel in MARGINS:
        for gyro in MARGINS:
            prior = (np.repeat([accel, gyro], 3) * SIGMA) ** 2 + WALKED
            weight = multivariate_normal(np.zeros(6), np.diag(prior) + cov).pdf(value)
            for margin in (accel, gyro):
                weight *= AS_SPECIFIED if margin == 1.0 else (1.0 - AS_SPECIFIED) / (len(MARGINS) - 1)
            yield weight, (accel, gyro)


def test_a_margin_is_its_mean_under_the_density_of_the_data():
    cov, value = data(np.random.default_rng(1), 5.0)
    weights, pairs = zip(*weighted_pairs(cov, value), strict=True)
    assert np.allclose(np.log(found(cov, value)), np.average(np.log(pairs), axis=0, weights=weights), rtol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_with_the_doubt_the_covariance_is_that_of_all_margins_together(seed):
    """Second moments of the estimates with each about that with the margins in use; never less than its own."""
    cov, value = data(np.random.default_rng(seed), 3.0)
    likely = likely_margins(*estimate(cov, value, (2.0, 1.0)), SIGMA, WALKED, (2.0, 1.0))
    used, used_cov = estimate(cov, value, likely.margins)
    weights, moments = [], []
    for weight, margins in weighted_pairs(cov, value):
        biases, own = estimate(cov, value, margins)
        weights.append(weight)
        moments.append(own + np.outer(biases - used, biases - used))
    lacking = np.average(moments, axis=0, weights=weights) - used_cov
    values, vectors = np.linalg.eigh(lacking)
    assert np.allclose(likely.doubt, (vectors * np.maximum(values, 0.0)) @ vectors.T, rtol=1e-6, atol=1e-12)


def test_data_that_are_certain_leave_no_doubt():
    cov, value = data(np.random.default_rng(5), 8.0, seen=1e-3)
    likely = likely_margins(*estimate(cov, value, (8.0, 8.0)), SIGMA, WALKED, (8.0, 8.0))
    assert np.abs(likely.doubt).max() < 1e-3 * np.diag(cov).max()


def test_what_is_found_does_not_depend_on_the_prior_that_was_used():
    for seed in range(10):
        cov, value = data(np.random.default_rng(seed), 4.0)
        each = [found(cov, value, margins) for margins in ((1.0, 1.0), (11.0, 1.0), (3.0, 7.0))]
        assert np.ptp(np.log(each), axis=0).max() < 2.0 * np.log(CHANGED)


def test_a_covariance_that_is_none_by_rounding_leaves_the_prior_as_it_is():
    cov, value = data(np.random.default_rng(3), 5.0)
    likely = likely_margins(value, -cov, SIGMA, WALKED, (2.0, 3.0))
    assert likely.margins == (2.0, 3.0)
    assert not likely.doubt.any()


def test_data_that_say_nothing_leave_the_prior_as_it_is():
    cov, value = data(np.random.default_rng(2), 1.0, seen=100.0)
    assert max(found(cov, value)) < 1.2


@pytest.mark.parametrize(("times", "low", "high"), [(1.0, 1.0, 1.2), (6.0, 3.5, 9.0)])
def test_the_usual_margin_is_that_of_the_biases(times, low, high):
    """Of 50 IMUs each; one that is as specified is hardly ever taken for another."""
    margins = np.array([found(*data(np.random.default_rng(seed), times)) for seed in range(50)])
    assert (np.median(margins, axis=0) >= low).all() and (np.median(margins, axis=0) <= high).all()
    if times == 1.0:
        assert np.mean(margins > EXCESSIVE) < 0.03


def test_what_cannot_be_a_bias_is_said():
    small, accel, gyro = np.full(3, 1e-3), np.array([0.0, -8.8, 0.0]), np.array([0.0, 0.0, 0.5])
    assert implausible(small, small, IMU) == ""
    assert implausible(0.9 * IMPLAUSIBLE * SIGMA[:3], 0.9 * IMPLAUSIBLE * SIGMA[3:], IMU) == ""
    assert "in g" in implausible(accel, small, IMU)
    assert "T_cam_imu" in implausible(small, gyro, IMU)
