"""How exact the time stamps of a sensor are, seen in the planes that pass through its events.

What an edge's shape and the pixels' thresholds do to a neighbour's time is a distance, and so in time proportional to
the plane's slope; what the time stamps do is not. Over the planes of a batch the variance of the residuals is
sigma_t^2 + kappa^2 |grad_T|^2: the first term shows where edges are fast.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.config import FlowSettings
from velod.events.plane_fit import SIZE, USUAL_RMS_PX, fit_plane
from velod.types import F64, U32

GROUPS = 4
"""Planes are sorted by slope into so many groups, each of which counts with its medians."""
MIN_PLANES = 40
"""A batch with fewer tells nothing."""
MOST_PLANES = 2048
"""Of more there is no need; the paper's quota is far below."""
GAIN = 0.5
"""Share of a new batch in the estimate."""
MEDIAN_OF_VARIANCE = 1.0 / 0.97
"""Mean over median of a variance seen in 22 degrees of freedom."""


class TimeNoise:
    """A running estimate, 0 at first. Gates that know of it let in more, so it approaches its value from below."""

    def __init__(self, settings: FlowSettings) -> None:
        self._settings = settings
        self._variance = 0.0

    @property
    def sigma_ns(self) -> int:
        """Standard deviation of the time stamps' errors, ns."""
        return round(1e9 * float(np.sqrt(self._variance)))

    def learn(self, patch: U32) -> None:
        """``patch`` (n, 25): ages in ns of the 5x5 neighbours of the events selected in a batch, 0 = none."""
        s = self._settings
        slope2, variance = np.empty(len(patch)), np.empty(len(patch))
        n = _residuals(
            patch, s.reject_px, s.rejections, s.min_neighbours, float(np.sqrt(self._variance)), slope2, variance
        )
        if n >= MIN_PLANES:
            self._variance += GAIN * (noise_variance(slope2[:n], variance[:n]) - self._variance)


def noise_variance(slope2: F64, variance: F64) -> float:
    """sigma_t^2, s^2, from |grad_T|^2, s^2/px^2, and the residuals' variance, s^2, of n planes each (n,).

    Least squares in relative terms over the medians of groups; neither term is negative, and kappa is at least what
    is usual, so that planes of one slope alone do not pass for noise.
    """
    order = np.argsort(slope2)
    slope2, variance = slope2[order], variance[order]
    size, larger = divmod(len(order), GROUPS)
    stop = 0
    # min over (a, k) of |(a + k s) / q - 1|^2; a few numbers, which Python adds up sooner than numpy is asked to
    aa = ak = kk = a1 = k1 = 0.0
    for group in range(GROUPS):
        start, stop = stop, stop + size + (group < larger)
        s = _middle(slope2[start:stop])
        q = MEDIAN_OF_VARIANCE * _middle(np.sort(variance[start:stop]))
        aa, ak, kk = aa + 1.0 / q**2, ak + s / q**2, kk + (s / q) ** 2
        a1, k1 = a1 + 1.0 / q, k1 + s / q
    usual = USUAL_RMS_PX**2
    a = (a1 * kk - k1 * ak) / max(aa * kk - ak * ak, 1e-12 * aa * kk)
    k = (k1 - a * ak) / kk
    if k < usual:
        a = (a1 - usual * ak) / aa
    return max(float(a), 0.0)


def _middle(ascending: F64) -> float:
    """The median of sorted numbers; ``np.median`` takes ten times as long for so few."""
    n = len(ascending)
    return 0.5 * float(ascending[(n - 1) // 2] + ascending[n // 2])


@njit(cache=True, nogil=True)
def _residuals(
    patch: U32,
    reject_px: float,
    rejections: int,
    min_neighbours: int,
    time_noise_s: float,
    slope2: F64,
    variance: F64,
) -> int:
    """Squared slope and residual variance of the planes that there are; returns how many."""
    age = np.empty(SIZE, np.float64)
    m = 0
    for i in range(len(patch)):
        for j in range(SIZE):
            age[j] = patch[i, j] * 1e-9
        n, gx, gy, _, rms, _, _, _ = fit_plane(age, reject_px, rejections, min_neighbours, time_noise_s)
        if n > 3 and rms > 0.0:
            slope2[m] = gx * gx + gy * gy
            variance[m] = n * rms * rms / (n - 3)
            m += 1
    return m
