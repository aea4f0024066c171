"""The sliding window: control points, biases and gravity of the last segments, in information form.

States, in this order: c_k, c_{k+1}, c_{k+2}, then for every segment k its newest control point c_{k+3}, its biases
b_a and b_w, g_L, the specific force of gravity in the frame L at the segment (Eq. 12, with gravity beside the
biases), and what all flows of the moment have wrong in common (``flow_equation.COMMON``). All factors are linear in
the states at the linearisation of their first sight, so that they add up in one information matrix, and leaving the
window (marginalisation) is a Schur complement that loses nothing.

States older than all factors to come are eliminated once, not with every solution: what is left, the front, is small.
A factor that comes late renews it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from velod.config import ImuSettings
from velod.geometry.so3 import hat
from velod.optimizer import envelope
from velod.optimizer.bins import BIN_NS
from velod.optimizer.interval import BLOCK, HEAD, Interval
from velod.optimizer.spline import fill_basis, locate
from velod.types import F64, I64

UNKNOWN_VELOCITY = 100.0
"""Prior sigma of the first control points, m/s: no knowledge."""
ACCELERATION = 3.0
"""Sigma of the acceleration at the start, m/s^2, where the specific force's norm does not speak of more."""
NO_NOISE = 1e15
"""Information of a gyroscope's noise that is none, (rad/s)^-2."""
NORM_SIGMA = 0.02
"""Of |g| = gravity, m/s^2: local gravity differs from the setting."""

_GONE = np.concatenate([np.arange(3), HEAD + np.arange(3, BLOCK)])
"""Columns of what leaves with the oldest segment: its first control point, its biases and its gravity."""
_SELECTED = np.arange(3, 15)
COMMON_S = np.array([3.0, 100.0, 100.0])
"""How long common errors last, s: the flow's scale changes with the scene, delay and depth's scale are the rig's."""


class Solution:
    """States of the window at their optimum; valid until the window's next solve, whose workspace it uses."""

    def __init__(self, x: F64, U: F64, last: I64) -> None:
        self.x = x
        self._U, self._last = U, last

    def cov(self, F: F64) -> F64:
        """Covariance of F x, for F of shape (r, n)."""
        out = np.zeros((len(F), len(F)))
        envelope.add_covariance(self._U, self._last, F.copy(), out)
        return out


class Window:
    """Information over the segments ``first`` .. ``last``."""

    def __init__(
        self,
        imu: ImuSettings,
        knot_ns: int,
        segments: int,
        smoothness: float,
        common_sigma: F64,
        bias_margins: tuple[float, float] = (1.0, 1.0),
        shared_gyro_noise: bool = True,
    ) -> None:
        """``smoothness``: sigma of the second difference of control points, m/s; weak, so that none is free.

        ``common_sigma`` (3,): of the common errors of the flows; ``bias_margins`` are on the sigmas of b_a and b_w at
        the start;
        ``shared_gyro_noise``: whether intervals leave the gyroscope's noise to be found by the flows as well.
        """
        self._bias_margins = bias_margins
        self._common_sigma = common_sigma
        self._common_lasts = np.ones(3)
        self._shared_gyro_noise = shared_gyro_noise
        self.use_noise(imu)
        self._knot_ns = knot_ns
        self._segments = segments
        self._smoothness = smoothness
        size = HEAD + BLOCK * (segments + 1)
        self._H = np.zeros((size, size))
        self._h = np.zeros(size)
        self._end = np.zeros(size, np.int64)  # no state at or after it has met that of the row in a factor
        self._U, self._last = np.zeros((size, size)), np.empty(size, np.int64)  # of the last solve
        self._x = np.empty(size)
        # What is left of H and h from column ``_front`` on once the states before are eliminated, which the first
        # rows of U, last and _forward hold; -1: to be renewed.
        self._front = -1
        self._front_H, self._front_h = np.zeros((size, size)), np.zeros(size)
        self._front_end = np.zeros(size, np.int64)
        self._forward = np.zeros(size)
        self.first = 0
        self.last = -1
        self._started = 0  # the first segment of all

    def use_noise(self, imu: ImuSettings) -> None:
        """From here on the IMU has these densities and walks; what has been added keeps its own."""
        self._imu = imu
        self._noise_information = BIN_NS * 1e-9 / imu.gyro_noise**2 if self._shared_gyro_noise else NO_NOISE

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

    def start(self, t_ns: int, force_L: F64) -> None:
        """Open the first segment, that of ``t_ns``, knowing nothing but priors.

        ``force_L`` (3,): the specific force of the moment, of which gravity is what acceleration leaves. The closer
        its norm is to gravity's, the less acceleration there will be in it.
        """
        self.first = self.last = locate(t_ns, self._knot_ns)[0]
        self._H[:] = 0.0
        self._h[:] = 0.0
        self._end[:] = np.arange(1, len(self._end) + 1)
        self._front = -1
        at = np.arange(HEAD)
        self._H[at, at] = 1.0 / UNKNOWN_VELOCITY**2
        self._started = self.first
        b = self.bias_columns(self.last)
        self._H[b, b] = self._bias_information()
        g = self.gravity_columns(self.last)
        gravity = self._imu.gravity
        acceleration = math.hypot(ACCELERATION, 2.0 * (float(np.linalg.norm(force_L)) - gravity))
        self._H[g, g] = 1.0 / min(acceleration, gravity) ** 2
        if acceleration < gravity:
            self._h[g] = force_L / acceleration**2
        c = self.common_columns(self.last)
        self._H[c, c] = 1.0 / self._common_sigma**2
        self._smooth_newest()

    @property
    def holds_start(self) -> bool:
        """Whether the first segment of all is in the window, and ``widen_bias_prior`` exact."""
        return not self.empty and self.first == self._started

    def widen_bias_prior(self, margins: tuple[float, float]) -> None:
        """Put other ``margins`` on the sigmas of the biases at the start, which must be in the window still.

        All factors being linear, the states become those that they would be with them from the start.
        """
        b = self.bias_columns(self._started)
        self._H[b, b] -= self._bias_information()
        self._bias_margins = margins
        self._H[b, b] += self._bias_information()
        self._front = -1

    def _bias_information(self) -> F64:
        """Of [b_a, b_w] (6,) at the start."""
        sigma = np.array([self._imu.accel_bias_sigma, self._imu.gyro_bias_sigma]) * self._bias_margins
        return np.repeat(sigma**-2.0, 3)

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
        self._carry_common(dt)
        self._smooth_newest()

    def control_columns(self, segment: int) -> list[int]:
        """First column of each of the four control points of a segment."""
        return [_control_column(segment - self.first + i) for i in range(4)]

    def bias_columns(self, segment: int) -> np.ndarray:
        """Columns of [b_a, b_w] of a segment, (6,)."""
        return HEAD + BLOCK * (segment - self.first) + 3 + np.arange(6)

    def gravity_columns(self, segment: int) -> np.ndarray:
        """Columns of g_L of a segment, (3,)."""
        return HEAD + BLOCK * (segment - self.first) + 9 + np.arange(3)

    def common_columns(self, segment: int) -> np.ndarray:
        """Columns of the common errors of a segment, (3,)."""
        return HEAD + BLOCK * (segment - self.first) + 12 + np.arange(3)

    def spline_row(self, t_ns: int) -> F64:
        """F (3, n) with F x = the spline at ``t_ns`` (Eq. 7)."""
        segment, u = locate(t_ns, self._knot_ns)
        F = np.zeros((3, self.size))
        _place_spline(F, segment - self.first, u)
        return F

    def selector(self, t_ns: int) -> F64:
        """F (12, n) with F x = [spline at t_ns, b_a, b_w, g_L of its segment]."""
        return self.selector_with_common(t_ns)[:12]

    def selector_with_common(self, t_ns: int) -> F64:
        """F (15, n): ``selector``, and the common errors of the segment."""
        segment, u = locate(t_ns, self._knot_ns)
        F = np.zeros((15, self.size))
        _place_spline(F, segment - self.first, u)
        own = HEAD + BLOCK * (segment - self.first)
        F[_SELECTED, own + _SELECTED] = 1.0
        return F

    def add(self, J: F64, r: F64, information: F64) -> None:
        """A factor (J x - r)^T information (J x - r)."""
        _add_factor(self._H, self._h, self._end, J, r, information)
        self._front = -1

    def add_interval(self, interval: Interval) -> None:
        """IMU and flows of a complete interval."""
        self._fold(interval, self._H, self._h, self._end)
        if self._oldest_column(interval) >= self._front:
            self._fold(interval, self._front_H, self._front_h, self._front_end)
        else:
            self._front = -1

    def shift(self, offset: F64, common: F64) -> None:
        """Count states from another origin: every control point + offset (3,), every common error + ``common`` (3,).

        The information is the same.
        """
        n = self.size
        change = np.zeros(n)
        for segment in range(self.first, self.last + 1):
            for column in self.control_columns(segment):
                change[column : column + 3] = offset
            change[self.common_columns(segment)] = common
        self._h[:n] += self._H[:n, :n] @ change
        self._front = -1

    def begin_common_anew(self, index: int) -> None:
        """The next segment's common error ``index`` has nothing to do with those before."""
        self._common_lasts[index] = 0.0

    def solve(self, extra: Sequence[Interval], g_prior: F64 | None, g_sigma: float) -> Solution:
        """The optimum with further intervals that are not kept.

        ``g_prior``: last estimate of g_L, ``g_sigma`` the sigma of its direction (rad). The norm of gravity is a
        factor along it on the newest segment, weakened by what a wrong direction would do to the linearisation.
        Raises numpy.linalg.LinAlgError where the information does not determine the states.
        """
        front = self._oldest_column(extra[0]) if extra else 0
        if front != self._front:
            self._renew_front(front)
        n, x, rest = self.size, self._x[: self.size], slice(front, self.size)
        U, last = self._U, self._last
        envelope.copy(self._front_H, self._front_end, front, n, U)
        last[rest] = self._front_end[rest]
        x[:front], x[rest] = self._forward[:front], self._front_h[rest]
        for interval in extra:
            self._fold(interval, U, x, last)
        if g_prior is not None:
            direction = g_prior / np.linalg.norm(g_prior)
            sigma = NORM_SIGMA + self._imu.gravity * g_sigma**2
            at = int(self.gravity_columns(self.last)[0])
            g = slice(at, at + 3)
            U[g, g] += np.outer(direction, direction) / sigma**2
            x[g] += direction * self._imu.gravity / sigma**2
        self._factorise(front, n)
        envelope.forward(U, last, x, front, n)
        envelope.backward(U, last, x)
        return Solution(x, U, last)

    def _fold(self, interval: Interval, H: F64, h: F64, end: I64) -> None:
        interval.fold(self._noise_information, self._knot_ns, self.first, H, h, end)

    def _oldest_column(self, interval: Interval) -> int:
        """The first column that an interval may speak of."""
        return _control_column(locate(interval.t_i, self._knot_ns)[0] - self.first)

    def _renew_front(self, front: int) -> None:
        """Eliminate the states before column ``front``."""
        n, rest = self.size, slice(front, self.size)
        U, last, y = self._U, self._last, self._forward
        envelope.copy(self._H, self._end, 0, n, U)
        last[:n], y[:n] = self._end[:n], self._h[:n]
        self._factorise(0, front)
        envelope.forward(U, last, y, 0, front)
        reach = int(last[:front].max(initial=front))
        np.maximum(last[front:reach], reach, out=last[front:reach])
        self._front_end[rest], self._front_h[rest] = last[rest], y[rest]
        envelope.copy(U, last, front, n, self._front_H)
        self._front = front

    def _factorise(self, start: int, stop: int) -> None:
        if not envelope.factorise(self._U, self._last, start, stop):
            raise np.linalg.LinAlgError("the information of the window is not positive definite")

    def _carry_common(self, dt: float) -> None:
        """The common errors of the newest segment are those of the one before, ``dt`` s earlier, less and less."""
        kept = np.exp(-dt / COMMON_S) * self._common_lasts
        self._common_lasts[:] = 1.0
        J = np.zeros((3, self.size))
        J[np.arange(3), self.common_columns(self.last)] = 1.0
        J[np.arange(3), self.common_columns(self.last - 1)] = -kept
        self.add(J, np.zeros(3), np.diag(1.0 / (self._common_sigma**2 * (1.0 - kept**2))))

    def _smooth_newest(self) -> None:
        """The newest control point continues the line through the two before, weakly."""
        c = self.control_columns(self.last)
        J = np.zeros((3, self.size))
        for column, weight in zip(c[1:], (1.0, -2.0, 1.0), strict=True):
            J[np.arange(3), column + np.arange(3)] = weight
        self.add(J, np.zeros(3), np.eye(3) / self._smoothness**2)

    def _marginalise_oldest(self) -> None:
        """Schur complement of the oldest control point, biases and gravity; the rest moves up."""
        n, m = self.size, self.size - BLOCK
        H, h, end = self._H, self._h, self._end
        # states that met one of those that go now meet each other
        reach = int(end[_GONE].max())
        _eliminate(H, h, _GONE, reach)
        newer = slice(HEAD + BLOCK, n)
        H[:HEAD, :HEAD] = H[3 : 3 + HEAD, 3 : 3 + HEAD]
        H[:HEAD, HEAD:m] = H[3 : 3 + HEAD, newer]
        H[HEAD:m, :HEAD] = H[newer, 3 : 3 + HEAD]
        H[HEAD:m, HEAD:m] = H[newer, newer]
        h[:HEAD], h[HEAD:m] = h[3 : 3 + HEAD], h[newer]
        end[:HEAD] = np.maximum(end[3 : 3 + HEAD], reach) - BLOCK
        end[HEAD:m] = np.maximum(end[newer] - BLOCK, np.arange(HEAD + 1, m + 1))
        H[m:], H[:, m:], h[m:] = 0.0, 0.0, 0.0
        end[m:] = np.arange(m + 1, len(end) + 1)
        self.first += 1
        self._front = -1


@njit(cache=True, nogil=True)
def _control_column(k: int) -> int:
    """Column of the control point ``k`` after the oldest of the window."""
    return HEAD + BLOCK * (k - 3) if k >= 3 else 3 * k


@njit(cache=True, nogil=True)
def _place_spline(F: F64, k: int, u: float) -> None:
    """Eq. 7 at ``u`` within the ``k``-th segment into the first three rows of F."""
    weights = np.empty(4)
    fill_basis(u, weights)
    for a in range(4):
        column = _control_column(k + a)
        for i in range(3):
            F[i, column + i] = weights[a]


@njit(cache=True, nogil=True)
def _add_factor(H: F64, h: F64, end: I64, J: F64, r: F64, information: F64) -> None:
    """H += J^T information J and h += J^T information r, over the columns of J (m, n) that are not zero."""
    m, n = J.shape
    columns, row = np.empty(n, np.int64), np.empty(m)
    count = 0
    for c in range(n):
        for p in range(m):
            if J[p, c] != 0.0:
                columns[count] = c
                count += 1
                break
    for a in range(count):
        i = columns[a]
        end[i] = max(end[i], columns[count - 1] + 1)
        for q in range(m):
            row[q] = 0.0
            for p in range(m):
                row[q] += J[p, i] * information[p, q]
            h[i] += row[q] * r[q]
        for b in range(a, count):
            j = columns[b]
            s = 0.0
            for q in range(m):
                s += row[q] * J[q, j]
            H[i, j] += s
            if i != j:
                H[j, i] += s


@njit(cache=True, nogil=True)
def _eliminate(H: F64, h: F64, gone: I64, reach: int) -> None:
    """Schur complement of the states ``gone``, none of which has met one at or after ``reach``."""
    for p in gone:
        for i in range(reach):
            if i == p or H[i, p] == 0.0:
                continue
            f = H[i, p] / H[p, p]
            h[i] -= f * h[p]
            for j in range(i, reach):
                H[i, j] -= f * H[p, j]
                H[j, i] = H[i, j]
        H[p, :] = 0.0
        H[:, p] = 0.0
