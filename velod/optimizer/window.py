"""The sliding window: control points, biases and gravity of the last segments, in information form.

States, in this order: c_k, c_{k+1}, c_{k+2}, then for every segment k its newest control point c_{k+3}, its biases
b_a and b_w, and g_L, the specific force of gravity in the frame L at the segment (Eq. 12, with gravity beside the
biases). All factors are linear in the states at the linearisation of their first sight, so that they add up in one
information matrix, and leaving the window (marginalisation) is a Schur complement that loses nothing.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from velod.config import ImuSettings
from velod.geometry.so3 import hat
from velod.optimizer.spline import basis, locate
from velod.types import F64

BLOCK = 12
"""States of one segment: control point, b_a, b_w, g_L."""
HEAD = 9
"""The three control points before the first segment's own."""
UNKNOWN_VELOCITY = 100.0
"""Prior sigma of the first control points, m/s: no knowledge."""
NORM_SIGMA = 0.02
"""Of |g| = gravity, m/s^2: local gravity differs from the setting."""


class Solution:
    """States of the window at their optimum."""

    def __init__(self, x: F64, factor: tuple[F64, bool]) -> None:
        self.x = x
        self._factor = factor

    def cov(self, F: F64) -> F64:
        """Covariance of F x, for F of shape (r, n)."""
        return np.asarray(F @ cho_solve(self._factor, F.T))


class Window:
    """Information over the segments ``first`` .. ``last``."""

    def __init__(self, imu: ImuSettings, knot_ns: int, segments: int, smoothness: float) -> None:
        """``smoothness``: sigma of the second difference of control points, m/s; weak, so that none is free."""
        self._imu = imu
        self._knot_ns = knot_ns
        self._segments = segments
        self._smoothness = smoothness
        size = HEAD + BLOCK * (segments + 1)
        self._H = np.zeros((size, size))
        self._h = np.zeros(size)
        self.first = 0
        self.last = -1

    @property
    def empty(self) -> bool:
        """Whether no segment has been opened yet."""
        return self.last < self.first

    @property
    def size(self) -> int:
        """Number of states."""
        return HEAD + BLOCK * (self.last - self.first + 1)

    def contains(self, t_ns: int) -> bool:
        """Whether ``t_ns`` lies in a segment of the window."""
        return not self.empty and self.first <= locate(t_ns, self._knot_ns)[0] <= self.last

    def start(self, t_ns: int) -> None:
        """Open the first segment, that of ``t_ns``, knowing nothing but the priors of the biases."""
        self.first = self.last = locate(t_ns, self._knot_ns)[0]
        self._H[:] = 0.0
        self._h[:] = 0.0
        at = np.arange(HEAD)
        self._H[at, at] = 1.0 / UNKNOWN_VELOCITY**2
        b = self.bias_columns(self.last)
        sigma = np.repeat([self._imu.accel_bias_sigma, self._imu.gyro_bias_sigma], 3)
        self._H[b, b] = 1.0 / sigma**2
        g = self.gravity_columns(self.last)
        self._H[g, g] = 1.0 / self._imu.gravity**2
        self._smooth_newest()

    def extend(self, D_L: F64, g_L: F64, b_w: F64, dt: float) -> None:
        """Open the next segment, marginalising the oldest when the window is full.

        ``D_L`` (3, 3) is the integral of R_LB over the last segment, ``dt`` seconds; ``g_L`` and
        ``b_w``: the linearisation of how gravity turns in L: d g_L = -[g_L]x D_L (b_w - b_w_linearised) + noise.
        """
        if self.last - self.first + 1 >= self._segments:
            self._marginalise_oldest()
        self.last += 1
        old_b, new_b = self.bias_columns(self.last - 1), self.bias_columns(self.last)
        walk = np.repeat([self._imu.accel_bias_walk, self._imu.gyro_bias_walk], 3) ** 2 * dt
        J = np.zeros((6, self.size))
        J[np.arange(6), new_b], J[np.arange(6), old_b] = 1.0, -1.0
        self.add(J, np.zeros(6), np.diag(1.0 / walk))
        old_g, new_g = self.gravity_columns(self.last - 1), self.gravity_columns(self.last)
        turn = hat(g_L) @ D_L
        J = np.zeros((3, self.size))
        J[np.arange(3), new_g], J[np.arange(3), old_g] = 1.0, -1.0
        J[:, old_b[3:]] = turn
        noise = hat(g_L) @ hat(g_L).T * self._imu.gyro_noise**2 * dt + np.eye(3) * 1e-8
        self.add(J, turn @ b_w, np.asarray(np.linalg.inv(noise)))
        self._smooth_newest()

    def control_columns(self, segment: int) -> list[int]:
        """First column of each of the four control points of a segment."""
        k = segment - self.first
        newest = [HEAD + BLOCK * (k + i - 3) if k + i >= 3 else 3 * (k + i) for i in range(4)]
        return newest

    def bias_columns(self, segment: int) -> np.ndarray:
        """Columns of [b_a, b_w] of a segment, (6,)."""
        return HEAD + BLOCK * (segment - self.first) + 3 + np.arange(6)

    def gravity_columns(self, segment: int) -> np.ndarray:
        """Columns of g_L of a segment, (3,)."""
        return HEAD + BLOCK * (segment - self.first) + 9 + np.arange(3)

    def spline_row(self, t_ns: int) -> F64:
        """F (3, n) with F x = the spline at ``t_ns`` (Eq. 7)."""
        segment, u = locate(t_ns, self._knot_ns)
        F = np.zeros((3, self.size))
        for column, weight in zip(self.control_columns(segment), basis(u), strict=True):
            F[np.arange(3), column + np.arange(3)] = weight
        return F

    def selector(self, t_ns: int) -> F64:
        """F (12, n) with F x = [spline at t_ns, b_a, b_w, g_L of its segment]."""
        segment, _ = locate(t_ns, self._knot_ns)
        F = np.zeros((12, self.size))
        F[:3] = self.spline_row(t_ns)
        F[np.arange(3, 9), self.bias_columns(segment)] = 1.0
        F[np.arange(9, 12), self.gravity_columns(segment)] = 1.0
        return F

    def add(self, J: F64, r: F64, information: F64) -> None:
        """A factor (J x - r)^T information (J x - r)."""
        H, h = self._H, self._h
        columns = np.flatnonzero(J.any(axis=0))
        Jc = J[:, columns]
        weighted = Jc.T @ information
        H[np.ix_(columns, columns)] += weighted @ Jc
        h[columns] += weighted @ r

    def add_information(self, t_ns: int, L: F64, eta: F64) -> None:
        """Information (6, 6) of [spline, b_w] at ``t_ns``."""
        segment, u = locate(t_ns, self._knot_ns)
        weights = basis(u)
        spread = np.zeros((6, 15))
        for i in range(4):
            spread[:3, 3 * i : 3 * i + 3] = weights[i] * np.eye(3)
        spread[3:, 12:] = np.eye(3)
        columns = np.concatenate(
            [c + np.arange(3) for c in self.control_columns(segment)] + [self.bias_columns(segment)[3:]]
        )
        self._H[np.ix_(columns, columns)] += spread.T @ L @ spread
        self._h[columns] += spread.T @ eta

    def solve(self, extra: list[tuple[F64, F64, F64]], g_prior: F64 | None, g_sigma: float) -> Solution:
        """The optimum with further factors (J, r, information) that are not kept.

        ``g_prior``: last estimate of g_L, ``g_sigma`` the sigma of its direction (rad). The norm of gravity is a
        factor along it on the newest segment, weakened by what a wrong direction would do to the linearisation.
        """
        n = self.size
        H, h = self._H[:n, :n].copy(), self._h[:n].copy()
        for J, r, information in extra:
            H += J.T @ information @ J
            h += J.T @ information @ r
        if g_prior is not None:
            direction = g_prior / np.linalg.norm(g_prior)
            sigma = NORM_SIGMA + self._imu.gravity * g_sigma**2
            g = self.gravity_columns(self.last)
            H[np.ix_(g, g)] += np.outer(direction, direction) / sigma**2
            h[g] += direction * self._imu.gravity / sigma**2
        factor = cho_factor(H, lower=True)
        return Solution(cho_solve(factor, h), factor)

    def _smooth_newest(self) -> None:
        """The newest control point continues the line through the two before, weakly."""
        c = self.control_columns(self.last)
        J = np.zeros((3, self.size))
        for column, weight in zip(c[1:], (1.0, -2.0, 1.0), strict=True):
            J[np.arange(3), column + np.arange(3)] = weight
        self.add(J, np.zeros(3), np.eye(3) / self._smoothness**2)

    def _marginalise_oldest(self) -> None:
        """Schur complement of the oldest control point, biases and gravity; the rest moves up."""
        n = self.size
        first_block = np.arange(HEAD, HEAD + BLOCK)
        gone = np.concatenate([np.arange(3), first_block[3:]])
        kept = np.concatenate([np.arange(3, HEAD), first_block[:3], np.arange(HEAD + BLOCK, n)])
        H, h = self._H[:n, :n], self._h[:n]
        factor = cho_factor(H[np.ix_(gone, gone)], lower=True)
        cross = H[np.ix_(gone, kept)]
        kept_H = H[np.ix_(kept, kept)] - cross.T @ cho_solve(factor, cross)
        kept_h = h[kept] - cross.T @ cho_solve(factor, h[gone])
        m = n - BLOCK
        self._H[:] = 0.0
        self._h[:] = 0.0
        self._H[:m, :m] = 0.5 * (kept_H + kept_H.T)
        self._h[:m] = kept_h
        self.first += 1
