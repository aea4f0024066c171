"""How wide the prior of the IMU's biases has to be, by what is found of them.

Sigmas of biases are those of a calibrated IMU; others turn up. A prior that is always wide costs a third of the
accuracy in the first second; a narrow one of a large bias costs more, and is sure of it. So accelerometer and
gyroscope have an unknown margin each on their sigmas. It is 1 unless the data are much likelier with another one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from velod.config import ImuSettings
from velod.geometry.cholesky import factorise, forward
from velod.types import F64

MARGINS = np.array([1.0, 1.5, 2.2, 3.3, 5.0, 7.5, 11.0])
"""What is tried; those beyond 1 are equally likely before anything is seen."""
AS_SPECIFIED = 0.95
"""Of sensors, whose biases are drawn with the specified sigma. With 0.8 the error without a bias is 1 % larger."""
EXCESSIVE = 3.0
"""A margin from which on the biases are not those of the IMU that the settings speak of."""
IMPLAUSIBLE = 30.0
"""Specified sigmas: no sensor has such a bias, 1.5 m/s^2 or 9 degrees per second by the usual settings."""
CHANGED = 1.1
"""A margin that differs by less from the one in use is the same."""

_PAIRS = np.array([(accel, gyro) for accel in MARGINS for gyro in MARGINS])
_EACH = np.repeat(_PAIRS, 3, axis=1)  # (pairs, 6), of b_a and b_w
_LOG_PRIOR = np.log(np.where(_PAIRS == 1.0, AS_SPECIFIED, (1.0 - AS_SPECIFIED) / (len(MARGINS) - 1))).sum(axis=1)


@dataclass(frozen=True, slots=True)
class Likely:
    """What the data say of the margins."""

    margins: tuple[float, float]  # on the sigmas of b_a and b_w: the mean of their logarithms
    information: F64  # (6, 6) of the biases with them
    doubt: F64  # (6, 6) what the biases' covariance lacks, since other margins are possible


def likely_margins(biases: F64, cov: F64, sigma: F64, walked: F64, margins: tuple[float, float]) -> Likely:
    """Margins of b_a and b_w on the specified ``sigma`` (6,) of the start.

    ``biases`` (6,) [m/s^2, rad/s] with ``cov`` (6, 6) are the estimate that was made with ``margins``, and ``walked``
    (6,) the variance that they may have gathered since the start.
    """
    information = np.asarray(np.linalg.inv(cov), np.float64)
    used = (np.repeat(margins, 3) * sigma) ** 2 + walked
    tried = (_EACH * sigma) ** 2 + walked
    right = information @ biases
    log_likelihood = np.empty(len(tried))
    _log_likelihoods(information, right, 1.0 / tried, 1.0 / used, log_likelihood)
    log_weight = log_likelihood + _LOG_PRIOR
    if not math.isfinite(log_weight.max()):  # a covariance that is none by rounding says nothing
        return Likely(margins, information, np.zeros((6, 6)))
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    log_margins = weight @ np.log(_PAIRS)
    in_use = information
    if np.abs(log_margins - np.log(margins)).max() >= np.log(CHANGED):
        accel, gyro = np.exp(log_margins)
        margins = float(accel), float(gyro)
        in_use = information + np.diag(1.0 / ((np.repeat(margins, 3) * sigma) ** 2 + walked) - 1.0 / used)
    with_each = information + (1.0 / tried - 1.0 / used)[:, :, None] * np.eye(6)
    return Likely(margins, in_use, _lacking(weight, with_each, right, in_use))


def _lacking(weight: F64, with_each: F64, right: F64, in_use: F64) -> F64:
    """Second moments of the estimates with informations (n, 6, 6) about that ``in_use``, less its own covariance.

    All have the same ``right`` side (6,); where they are less, nothing is lacking.
    """
    cov_each, cov = np.linalg.inv(with_each), np.linalg.inv(in_use)
    off = (cov_each - cov) @ right
    lacking = np.einsum("m,mij->ij", weight, cov_each) + (off.T * weight) @ off - cov
    values, vectors = np.linalg.eigh(0.5 * (lacking + lacking.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


@njit(cache=True, nogil=True)
def _log_likelihoods(information: F64, right: F64, tried: F64, used: F64, out: F64) -> None:
    """log of the density of the data with the biases integrated out, up to a constant, under each prior.

    ``tried`` (n, 6) are the priors' inverse variances, in place of ``used`` (6,), which is part of ``information``
    (6, 6). With A of the data and a prior together: right^T A^-1 right - log det A + log det tried, halved; NaN where
    A is not positive.
    """
    A, y = np.empty_like(information), np.empty_like(right)
    for m in range(len(tried)):
        A[:], y[:] = information, right
        for i in range(y.size):
            A[i, i] += tried[m, i] - used[i]
        factorise(A)
        forward(A, y)
        out[m] = 0.0
        for i in range(y.size):
            out[m] += 0.5 * (y[i] * y[i] + math.log(tried[m, i])) - math.log(A[i, i])


def implausible(b_a: F64, b_w: F64, imu: ImuSettings) -> str:
    """What cannot be a bias, in words: other units, or other axes, are taken for one. Empty if nothing is."""
    accel, gyro = float(np.abs(b_a).max()), float(np.abs(b_w).max())
    if accel > IMPLAUSIBLE * imu.accel_bias_sigma:
        return f"the accelerometer is off by {accel:.1f} m/s^2: is it in g?"
    if gyro > IMPLAUSIBLE * imu.gyro_bias_sigma:
        return f"the gyroscope is off by {gyro:.2f} rad/s: its axes, T_cam_imu?"
    return ""
