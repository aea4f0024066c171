"""One preintegration interval: what the IMU says of it, and the flows within, which share the gyroscope's noise.

The noise of a moment is in both: it turns the velocity that the IMU carries on, and it moves all flows of that moment
together. Taken as independent, both would err to the same side, too sure of it: sideways at 19 m/s by twice their
sigma. So it is a nuisance of each bin of BIN_NS, marginalised out of IMU and flows at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from velod.events.plane_fit import ANY_ORDER
from velod.optimizer import inertial_residual
from velod.optimizer.bins import BIN_NS, Bins
from velod.optimizer.envelope import factorise, forward
from velod.optimizer.preintegration import Preintegration
from velod.optimizer.spline import fill_basis
from velod.types import F64, I64

BLOCK = 15
"""States of one segment: control point, b_a, b_w, g_L, common errors of the flows."""
HEAD = 9
"""The three control points before the first segment's own."""

_POINTS, _OWN = 5, 12
_LOCAL = 3 * _POINTS + 2 * _OWN
"""States that an interval can meet: five control points, and what else two segments have."""


@dataclass(slots=True)
class Interval:
    """From ``t_i`` to ``t_j``; what the IMU says of it up to ``until``, at first nothing.

    That is a residual blocks x + noise n - r with ``information``, x = [spline(t_i), b_a, b_w, g_L, spline(until)].
    n are the gyroscope's noises of the bins, which flows add their information to.
    """

    t_i: int
    t_j: int
    until: int = field(init=False)
    blocks: F64 = field(default_factory=lambda: np.zeros((3, 15)))
    r: F64 = field(default_factory=lambda: np.zeros(3))
    information: F64 = field(default_factory=lambda: np.zeros((3, 3)))
    noise: F64 = field(init=False)  # (3, 3 bins)
    bin_s: F64 = field(init=False)  # (bins,) what the IMU says of each, s
    _A: F64 = field(init=False)  # normal equations of the noises, which are eliminated, then of the local states
    _g: F64 = field(init=False)
    _last: I64 = field(init=False)  # the whole rows: envelope.factorise
    _folded: bool = field(init=False, default=False)
    flows: Bins = field(init=False)

    def __post_init__(self) -> None:
        self.until = self.t_i
        first = self.t_i // BIN_NS
        self.flows = Bins(first, -(-self.t_j // BIN_NS) - first)
        self.noise = np.zeros((3, 3 * self.flows.count))
        self.bin_s = np.zeros(self.flows.count)
        size = _LOCAL + self.noise.shape[1]
        self._A, self._g, self._last = np.empty((size, size)), np.empty(size), np.empty(size, np.int64)

    def linearise(self, p: Preintegration, R_LB: F64, s_L: F64, on_error: bool, v_j: F64) -> None:
        """Take what the IMU says up to ``until``, of which ``p`` is the preintegration.

        ``R_LB`` (2 + bins, 3, 3) and ``s_L`` (2 + bins, 3) are those at ``times``; ``on_error``: whether the spline
        is that of the error e; ``v_j`` (3,): the velocity at ``until`` at which the residual is linearised.
        """
        inertial_residual.linearise(p, R_LB, s_L, on_error, v_j, self.blocks, self.r, self.information)
        self._folded = False

    def times(self) -> I64:
        """``t_i``, ``until``, and the middle of every bin, cut to what the IMU says; notes ``bin_s`` on the way."""
        out = np.empty(2 + self.flows.count, np.int64)
        _bin_times(self.t_i, self.until, self.flows.first, self.bin_s, out)
        return out

    def turn_by_noise(self, R_LB: F64, s_L: F64, e_L: F64) -> None:
        """Take what the gyroscope's noise does; R_LB and s_L as in ``linearise``, ``e_L`` (3,) at ``until``."""
        inertial_residual.turn_by_noise(self.bin_s, R_LB, s_L, e_L, self.noise)
        self._folded = False

    def add_flows(self, bins: Bins, stop: int, slope: F64) -> None:
        """``Bins.add``."""
        self.flows.add(bins, stop, slope)
        self._folded = False

    def shift(self, offset: F64, common: F64) -> None:
        """Count the spline and the common errors from another origin: their values + offset (3,), common (3,)."""
        self.r += (self.blocks[:, :3] + self.blocks[:, 12:]) @ offset
        self.flows.eta += self.flows.L[:, :, :3] @ offset + self.flows.L[:, :, 6:] @ common
        self._folded = False

    def noise_changed(self) -> None:
        """The next ``fold`` is with another noise."""
        self._folded = False

    def fold(self, noise_information: float, knot_ns: int, first: int, H: F64, h: F64, end: I64) -> None:
        """Add what IMU and flows say to the normal equations of a window whose first segment is ``first``.

        ``noise_information``: of the gyroscope's noise in one bin, (rad/s)^-2. Knots are the same in every call, and
        noise until ``noise_changed``: an interval that has got nothing new since the last one has its sum still.
        """
        if not self._folded:
            _fold(
                self.t_i, self.until, self.blocks, self.r, self.information, self.noise,
                self.flows.first, self.flows.total, self.flows.L, self.flows.eta,
                noise_information, knot_ns, self._A, self._g, self._last,
            )  # fmt: skip
            self._folded = True
        _spread(self._A, self._g, self.noise.shape[1], self.t_i // knot_ns - first, H, h, end)


@njit(cache=True, nogil=True)
def _bin_times(t_i: int, until: int, first_bin: int, bin_s: F64, times: I64) -> None:
    times[0], times[1] = t_i, until
    for k in range(bin_s.size):
        start = min(max((first_bin + k) * BIN_NS, t_i), until)
        stop = min(max((first_bin + k + 1) * BIN_NS, t_i), until)
        bin_s[k], times[2 + k] = (stop - start) * 1e-9, (start + stop) // 2


@njit(cache=True, nogil=True)
def _fold(
    t_i: int,
    until: int,
    blocks: F64,
    r: F64,
    information: F64,
    noise: F64,
    first_bin: int,
    total: F64,
    L: F64,
    eta: F64,
    noise_information: float,
    knot_ns: int,
    A: F64,
    g: F64,
    last: I64,
) -> None:
    A[:, :] = 0.0
    g[:] = 0.0
    last[:] = g.size
    segment, noises = t_i // knot_ns, noise.shape[1]
    _add_imu(t_i, until, segment, knot_ns, blocks, r, information, noise, A, g)
    for k in range(len(total)):
        for i in range(3):
            A[3 * k + i, 3 * k + i] += noise_information
        if total[k, 0] > 0.0:
            t = (first_bin + k) * BIN_NS + int(total[k, 1] / total[k, 0])
            _add_flows(t, segment, knot_ns, 3 * k, noises, L[k], eta[k], A, g)
    factorise(A, last, 0, noises)
    forward(A, last, g, 0, noises)


@njit(cache=True, nogil=True, fastmath=ANY_ORDER)
def _add_imu(t_i, until, segment, knot_ns, blocks, r, information, noise, A, g):  # type: ignore[no-untyped-def]
    J, w, noises = np.zeros((3, len(g))), np.empty(4), noise.shape[1]
    J[:, :noises] = noise
    for at, t in ((0, t_i), (12, until)):
        k = t // knot_ns
        fill_basis((t - k * knot_ns) / knot_ns, w)
        for a in range(4):
            for i in range(3):
                for j in range(3):
                    J[i, noises + 3 * (k - segment + a) + j] += w[a] * blocks[i, at + j]
    J[:, noises + 3 * _POINTS : noises + 3 * _POINTS + 9] = blocks[:, 3:12]
    for a in range(len(g)):
        if J[0, a] == 0.0 and J[1, a] == 0.0 and J[2, a] == 0.0:
            continue
        f0 = J[0, a] * information[0, 0] + J[1, a] * information[1, 0] + J[2, a] * information[2, 0]
        f1 = J[0, a] * information[0, 1] + J[1, a] * information[1, 1] + J[2, a] * information[2, 1]
        f2 = J[0, a] * information[0, 2] + J[1, a] * information[1, 2] + J[2, a] * information[2, 2]
        g[a] += f0 * r[0] + f1 * r[1] + f2 * r[2]
        row, j0, j1, j2 = A[a, a:], J[0, a:], J[1, a:], J[2, a:]
        for b in range(row.size):
            row[b] += f0 * j0[b] + f1 * j1[b] + f2 * j2[b]


@njit(cache=True, nogil=True)
def _add_flows(t, segment, knot_ns, n, noises, L, eta, A, g):  # type: ignore[no-untyped-def]
    """L (9, 9) and eta (9,) of [spline(t), b_w, common], in which the noise ``n`` enters as b_w does."""
    k = t // knot_ns
    own = noises + 3 * _POINTS + _OWN * (k - segment)
    w, column, part = np.ones(7), np.empty(7, np.int64), np.empty(7, np.int64)
    fill_basis((t - k * knot_ns) / knot_ns, w[1:5])
    column[0], part[0] = n, 3
    for a in range(4):
        column[1 + a], part[1 + a] = noises + 3 * (k - segment + a), 0
    column[5], part[5] = own + 3, 3
    column[6], part[6] = own + 9, 6
    # columns ascend: what is not on the diagonal is above it
    for a in range(7):
        for i in range(3):
            at, row = column[a] + i, part[a] + i
            g[at] += w[a] * eta[row]
            for j in range(i, 3):
                A[at, column[a] + j] += w[a] * w[a] * L[row, part[a] + j]
            for b in range(a + 1, 7):
                for j in range(3):
                    A[at, column[b] + j] += w[a] * w[b] * L[row, part[b] + j]


@njit(cache=True, nogil=True)
def _spread(A, g, noises, k, H, h, end):  # type: ignore[no-untyped-def]
    """Add the local states, after the noises, to those of the window; the interval begins in its ``k``-th segment."""
    columns = np.empty(_LOCAL, np.int64)
    for a in range(_POINTS):
        start = HEAD + BLOCK * (k + a - 3) if k + a >= 3 else 3 * (k + a)
        for i in range(3):
            columns[3 * a + i] = start + i
    for b in range(2):
        for i in range(_OWN):
            columns[3 * _POINTS + _OWN * b + i] = HEAD + BLOCK * (k + b) + 3 + i
    reach = 0
    for a in range(_LOCAL):
        if A[noises + a, noises + a] != 0.0:
            reach = max(reach, columns[a] + 1)
    for a in range(_LOCAL):
        row, i = A[noises + a, noises:], columns[a]
        if row[a] == 0.0:
            continue
        h[i] += g[noises + a]
        end[i] = max(end[i], reach)
        for b in range(a, _LOCAL):
            if row[b] != 0.0:
                j = columns[b]
                H[i, j] += row[b]
                if i != j:
                    H[j, i] += row[b]
