"""Do camera and gyroscope turn together, at the same time and about the same axes?

The flows of a batch say by themselves how the camera turns. What they make of the gyroscope's bias is, by batch,

    b_app = b_w + delay d w_B / dt + w_B x theta + share w_B,

where the stamps of the events are late by ``delay`` and the camera is turned against its calibration by ``theta``.
(The share is that of flows which come out too fast.) Angular velocity and acceleration are those before and after the
batch, never of its own moment, whose noise is in b_app as well and would draw the result towards zero.

The clock is asked where e is known from the window, since translation that is unknown hides much of a rotation; the
axes where it is free, since cameras that are turned falsify e too.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numba import njit

from velod.geometry.so3 import log_so3
from velod.optimizer.bins import BIN_NS, Bins
from velod.optimizer.inertial import InertialMemory
from velod.optimizer.small import invert3, multiply
from velod.types import F64, NS_PER_S

NEAR_NS, FAR_NS = 10_000_000, 40_000_000
"""Before and after a batch: from where to where the gyroscope is looked at."""
AROUND_NS = np.array([-FAR_NS, -NEAR_NS, NEAR_NS, FAR_NS])
BLOCK_NS = NS_PER_S // 4
"""Batches of so long are summed up: their scatter says how sure the result is."""
HELD = 60
"""Blocks that count."""
MIN_BLOCKS = 2
MIN_SCATTERED = 6
"""Blocks from which on their scatter is asked, too."""
DISTRUST = 4.0
"""On the covariance of e: a delay is in e as well."""
BIAS_SIGMA, ROTATION_SIGMA, SHARE_SIGMA = 0.1, 0.5, 0.01
"""Of what is asked beside the delay, before anything is known: rad/s, rad, 1."""
SURE = 3.0
"""Sigmas from which on a delay is taken out of the stamps ..."""
MAX_SIGMA_S = 0.7e-3
"""... if it is known this well, and cameras that are turned are not what falsifies it ..."""
STEP_SIGMA = 0.5
"""... after which so much of that step is uncertain, since e was wrong with it."""
FREE = np.eye(3) * 1e6
"""Covariance of an e of which nothing is known, (m/s)^2."""
DELAY = 3
ROTATION = slice(4, 7)


@dataclass(frozen=True, slots=True)
class Offsets:
    """Events against the IMU."""

    delay_s: float  # the events' stamps are so much late
    delay_sigma_s: float
    rotation_B: F64  # (3,) rad: the camera is turned so much from its calibration
    rotation_cov: F64  # (3, 3)

    @property
    def worst_turn(self) -> tuple[float, float, F64]:
        """About the axis (of those of ``rotation_cov``) that contradicts most: rad, its sigma, the axis."""
        variance, axes_B = np.linalg.eigh(self.rotation_cov)
        turned, sigma = self.rotation_B @ axes_B, np.sqrt(variance)
        worst = int(np.argmax(np.abs(turned) - SURE * sigma))
        return float(turned[worst]), float(sigma[worst]), axes_B[:, worst]


@dataclass(frozen=True, slots=True)
class _Turn:
    """What a batch says of [e, b_app] at ``t_ns``, and what is known of e there."""

    t_ns: int
    span_s: float
    L: F64  # (6, 6)
    eta: F64  # (6,)
    e_L: F64  # (3,)
    cov_e: F64  # (3, 3)


class RotationCheck:
    """Takes the batches' informations, and says what they say of clock and axes. ``late_ns`` has been taken out."""

    def __init__(self, delay_sigma_s: float, gyro_noise: float, correct: bool) -> None:
        """``delay_sigma_s``: of the delay before anything is known; ``gyro_noise``: density, rad/s/sqrt(Hz).

        ``correct``: whether a delay is ever to be taken out of the stamps.
        """
        self.gyro_noise, self._correct = gyro_noise, correct
        self._pending: deque[_Turn] = deque()
        self._axes, self._clock = _Sums(delay_sigma_s), _Sums(delay_sigma_s)
        self.late_ns = 0
        self.offsets: Offsets | None = None

    def add(self, bins: Bins, slope: F64, t_ns: int, e_L: F64, cov_e: F64) -> None:
        """The information of a batch, of which e at ``t_ns`` is ``e_L`` (3,) with ``cov_e`` (3, 3) by prediction."""
        L, eta = np.zeros((6, 6)), np.zeros(6)
        mean_ns = _sum_bins(bins.L, bins.eta, bins.total, bins.first, slope, L, eta)
        e_there = e_L + slope * ((mean_ns - t_ns) * 1e-9)
        self._pending.append(_Turn(mean_ns, bins.count * BIN_NS * 1e-9, L, eta, e_there, cov_e))

    def forget_pending(self) -> None:
        """The IMU has a hole."""
        self._pending.clear()

    def advance(self, memory: InertialMemory, t_ns: int) -> float:
        """Look at the batches that the IMU, integrated up to ``t_ns``, surrounds; a step to take out of stamps, s.

        The step, mostly 0, is in ``late_ns`` from then on.
        """
        while self._pending and self._pending[0].t_ns + FAR_NS <= t_ns:
            turn = self._pending.popleft()
            if turn.t_ns - FAR_NS < memory.t_ns[0]:
                continue
            R_LB, _, _ = memory.at(turn.t_ns + AROUND_NS)
            variance = self.gyro_noise**2 / turn.span_s
            closed = self._clock.add(turn, turn.cov_e * DISTRUST, variance, R_LB)
            self._axes.add(turn, FREE, variance, R_LB)
            if closed and (step := self._conclude()) != 0.0:
                return step
        return 0.0

    def _conclude(self) -> float:
        if (clock := self._clock.solution()) is None or (axes := self._axes.solution()) is None:
            return 0.0
        delay, sigma = float(clock[0][DELAY]), math.sqrt(clock[1][DELAY, DELAY])
        self.offsets = Offsets(delay + self.late_ns * 1e-9, sigma, axes[0][ROTATION], axes[1][ROTATION, ROTATION])
        turned, turned_sigma, _ = self.offsets.worst_turn
        if abs(turned) > SURE * turned_sigma or abs(delay) < SURE * sigma or sigma > MAX_SIGMA_S or not self._correct:
            return 0.0
        self.late_ns += round(delay * NS_PER_S)
        self._clock = _Sums(math.hypot(sigma, STEP_SIGMA * delay))
        self._pending.clear()
        return delay


class _Sums:
    """Normal equations of [b_w, delay, theta, share], in blocks."""

    def __init__(self, delay_sigma_s: float) -> None:
        sigma = np.array([BIAS_SIGMA] * 3 + [delay_sigma_s] + [ROTATION_SIGMA] * 3 + [SHARE_SIGMA])
        self._prior = np.diag(sigma**-2)
        self._blocks: deque[tuple[F64, F64]] = deque(maxlen=HELD)
        self._number = -1

    def add(self, turn: _Turn, cov_e: F64, variance: float, R_LB: F64) -> bool:
        """Whether a block has been completed by this batch; ``R_LB`` (4, 3, 3): the attitudes at ``AROUND_NS``."""
        number = turn.t_ns // BLOCK_NS
        begun = number != self._number
        if begun:
            self._blocks.append((np.zeros((8, 8)), np.zeros(8)))
            self._number = number
        H, h = self._blocks[-1]
        _add_turn(turn.L, turn.eta, turn.e_L, cov_e, variance, R_LB, H, h)
        return begun and len(self._blocks) > MIN_BLOCKS

    def solution(self) -> tuple[F64, F64] | None:
        """States (8,) and their covariance (8, 8)."""
        if len(self._blocks) < MIN_BLOCKS:
            return None
        H, h = np.array([b[0] for b in self._blocks]), np.array([b[1] for b in self._blocks])
        cov = np.linalg.inv(H.sum(axis=0) + self._prior)
        x = cov @ h.sum(axis=0)
        if len(h) >= MIN_SCATTERED:
            g = h - H @ x
            scattered = cov @ (g.T @ g) @ cov
            larger = np.maximum(np.diag(scattered) / np.diag(cov), 1.0) ** 0.5
            cov *= np.outer(larger, larger)
        return x, cov


@njit(cache=True, nogil=True)
def _rates(R_LB: F64, w_B: F64, w_dot_B: F64) -> None:
    """Angular velocity and acceleration (3,) in the midst of attitudes (4, 3, 3), from the turns before and after."""
    R, before, after, seconds = np.empty((3, 3)), np.empty(3), np.empty(3), (FAR_NS - NEAR_NS) * 1e-9
    multiply(R_LB[0].T, R_LB[1], R)
    log_so3(R, before)
    multiply(R_LB[2].T, R_LB[3], R)
    log_so3(R, after)
    for i in range(3):
        w_B[i] = (before[i] + after[i]) / (2.0 * seconds)
        w_dot_B[i] = (after[i] - before[i]) / (seconds * (FAR_NS + NEAR_NS) * 1e-9)


@njit(cache=True, nogil=True)
def _sum_bins(bin_L: F64, bin_eta: F64, total: F64, first: int, slope: F64, L: F64, eta: F64) -> int:
    """What bins say of [e, b_w], (6, 6) and (6,), at their mean time, which is returned."""
    weight = late = 0.0
    for k in range(len(total)):
        weight += total[k, 0]
        late += total[k, 1] + total[k, 0] * k * BIN_NS
    mean = late / max(weight, 1e-300)
    for k in range(len(total)):
        if not total[k, 0] > 0.0:
            continue
        dt = (mean - k * BIN_NS - total[k, 1] / total[k, 0]) * 1e-9
        for i in range(6):
            eta[i] += bin_eta[k, i]
            for j in range(6):
                L[i, j] += bin_L[k, i, j]
                if j < 3:
                    eta[i] += bin_L[k, i, j] * slope[j] * dt
    return first * BIN_NS + int(mean)


@njit(cache=True, nogil=True)
def _add_turn(L: F64, eta: F64, e: F64, cov_e: F64, variance: float, R_LB: F64, H: F64, h: F64) -> None:
    """Normal equations of b_app = J x, J = [1, w_dot, [w]x, w], with e marginalised that is known with ``cov_e``."""
    A, inverse, information, cov = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    gain, right, b, J = np.empty((3, 3)), np.empty(3), np.empty(3), np.zeros((3, 8))
    w_B, w_dot_B = np.empty(3), np.empty(3)
    _rates(R_LB, w_B, w_dot_B)
    invert3(cov_e, A)
    for i in range(3):
        right[i] = eta[i]
        for j in range(3):
            right[i] += A[i, j] * e[j]
    A += L[:3, :3]
    invert3(A, inverse)
    for i in range(3):
        for j in range(3):
            gain[i, j] = L[3 + i, 0] * inverse[0, j] + L[3 + i, 1] * inverse[1, j] + L[3 + i, 2] * inverse[2, j]
    for i in range(3):
        b[i] = eta[3 + i] - (gain[i, 0] * right[0] + gain[i, 1] * right[1] + gain[i, 2] * right[2])
        for j in range(3):
            information[i, j] = L[3 + i, 3 + j]
            for k in range(3):
                information[i, j] -= gain[i, k] * L[k, 3 + j]
    invert3(information, cov)
    right[:] = b
    for i in range(3):
        b[i] = cov[i, 0] * right[0] + cov[i, 1] * right[1] + cov[i, 2] * right[2]
        J[i, i], J[i, 3], J[i, 7] = 1.0, w_dot_B[i], w_B[i]
    J[0, 5], J[0, 6], J[1, 4], J[1, 6], J[2, 4], J[2, 5] = -w_B[2], w_B[1], w_B[2], -w_B[0], -w_B[1], w_B[0]
    for i in range(3):
        cov[i, i] += variance
    invert3(cov, information)
    for p in range(8):
        for k in range(3):
            row = J[0, p] * information[0, k] + J[1, p] * information[1, k] + J[2, p] * information[2, k]
            h[p] += row * b[k]
            for q in range(8):
                H[p, q] += row * J[k, q]
