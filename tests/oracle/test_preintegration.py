"""Preintegration (Eq. 9) against gtsam, and its Jacobians against central differences."""

import itertools

import gtsam
import numpy as np
import pytest

from velod.geometry.so3 import log
from velod.optimizer.preintegration import preintegrate

ACCEL_NOISE, GYRO_NOISE = 1.86e-2, 1.86e-3


def samples(seed, rate=200, seconds=0.1, w=5.0, a=20.0):
    """Smooth random motion, sampled."""
    rng = np.random.default_rng(seed)
    n = int(rate * seconds) + 1
    t = np.arange(n) / rate
    gyro = w * np.sin(2 * np.pi * rng.uniform(1, 3, 3) * t[:, None] + rng.uniform(0, 6, 3)) + rng.normal(size=3)
    accel = a * np.cos(2 * np.pi * rng.uniform(1, 3, 3) * t[:, None] + rng.uniform(0, 6, 3)) + [0, -9.81, 0]
    return (t * 1e9).astype(np.int64), accel, gyro


def by_gtsam(t_ns, accel, gyro, t_i, t_j, b_a, b_w, substeps):
    """gtsam on the same piecewise-linear signals, finely subdivided."""
    params = gtsam.PreintegrationParams.MakeSharedU(0.0)
    params.setAccelerometerCovariance(np.eye(3) * ACCEL_NOISE**2)
    params.setGyroscopeCovariance(np.eye(3) * GYRO_NOISE**2)
    params.setIntegrationCovariance(np.zeros((3, 3)))
    pim = gtsam.PreintegratedImuMeasurements(params, gtsam.imuBias.ConstantBias(b_a, b_w))
    edges = np.linspace(t_i, t_j, substeps + 1)
    for t0, t1 in itertools.pairwise(edges):
        at = 0.5 * (t0 + t1)
        a = np.array([np.interp(at, t_ns, accel[:, i]) for i in range(3)])
        w = np.array([np.interp(at, t_ns, gyro[:, i]) for i in range(3)])
        pim.integrateMeasurement(a, w, (t1 - t0) * 1e-9)
    return pim


@pytest.mark.parametrize("seed", range(4))
def test_preintegration_is_that_of_gtsam(seed):
    t_ns, accel, gyro = samples(seed)
    b_a, b_w = np.array([0.05, -0.02, 0.01]), np.array([0.01, 0.02, -0.03])
    t_i, t_j = 3_000_000, 71_000_000  # neither is the time of a sample
    p = preintegrate(t_ns, accel, gyro, t_i, t_j, b_a, b_w, ACCEL_NOISE, GYRO_NOISE)
    pim = by_gtsam(t_ns, accel, gyro, t_i, t_j, b_a, b_w, 4000)
    # what two half steps a sample leave of the coning: a tenth of the gyroscope's noise over the interval
    assert np.linalg.norm(log(p.R_gamma.T @ pim.deltaRij().matrix())) < 5e-5
    assert np.linalg.norm(p.beta - pim.deltaVij()) < 5e-4


def test_the_covariance_is_that_of_gtsam():
    t_ns, accel, gyro = samples(11)
    p = preintegrate(t_ns, accel, gyro, 0, 60_000_000, np.zeros(3), np.zeros(3), ACCEL_NOISE, GYRO_NOISE)
    pim = by_gtsam(t_ns, accel, gyro, 0, 60_000_000, np.zeros(3), np.zeros(3), 3000)
    cov = pim.preintMeasCov()  # [rotation, position, velocity]
    order = [0, 1, 2, 6, 7, 8]
    reference = cov[np.ix_(order, order)]
    scale = np.sqrt(np.outer(np.diag(reference), np.diag(reference)))
    assert np.abs((p.cov - reference) / scale).max() < 0.03


@pytest.mark.parametrize("seed", range(3))
def test_jacobians_to_the_biases_are_central_differences(seed):
    t_ns, accel, gyro = samples(seed, w=10.0)
    b = np.array([0.05, -0.02, 0.01, 0.01, 0.02, -0.03])
    span = (1_000_000, 93_000_000)

    def at(bias):
        return preintegrate(t_ns, accel, gyro, *span, bias[:3], bias[3:], ACCEL_NOISE, GYRO_NOISE)

    p, h = at(b), 1e-5
    for i in range(3):
        d = np.zeros(6)
        d[i] = h
        numeric = (at(b + d).beta - at(b - d).beta) / (2 * h)
        assert np.allclose(p.d_beta_d_ba[:, i], numeric, atol=1e-8)
        d = np.zeros(6)
        d[3 + i] = h
        plus, minus = at(b + d), at(b - d)
        assert np.allclose(p.d_beta_d_bw[:, i], (plus.beta - minus.beta) / (2 * h), atol=1e-7)
        theta = (log(p.R_gamma.T @ plus.R_gamma) - log(p.R_gamma.T @ minus.R_gamma)) / (2 * h)
        assert np.allclose(p.d_theta_d_bw[:, i], theta, atol=1e-7)


def test_an_interval_without_samples_is_refused():
    t_ns, accel, gyro = samples(0)
    with pytest.raises(ValueError, match="do not cover"):
        preintegrate(t_ns, accel, gyro, 50_000_000, 200_000_000, np.zeros(3), np.zeros(3), 1.0, 1.0)


def test_intervals_chain():
    t_ns, accel, gyro = samples(5)
    none = np.zeros(3)
    whole = preintegrate(t_ns, accel, gyro, 0, 90_000_000, none, none, ACCEL_NOISE, GYRO_NOISE)
    first = preintegrate(t_ns, accel, gyro, 0, 35_000_000, none, none, ACCEL_NOISE, GYRO_NOISE)
    second = preintegrate(t_ns, accel, gyro, 35_000_000, 90_000_000, none, none, ACCEL_NOISE, GYRO_NOISE)
    assert np.allclose(whole.R_gamma, first.R_gamma @ second.R_gamma, atol=1e-12)
    assert np.allclose(whole.beta, first.beta + first.R_gamma @ second.beta, atol=1e-12)
