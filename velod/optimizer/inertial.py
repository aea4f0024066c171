"""IMU samples in memory, and the motion integrated from them: the frame L.

L is B at the first sample, carried on by the gyroscope alone: R_LB(t). ``s_L(t)`` is the integral of
R_LB (a - b_a), gravity included; the velocity is v_B = R_BL (s_L + e), whose error e is what the spline models. R_LB
and s_L are fixed functions of time once integrated: whatever is wrong with them (bias, gravity, start) is in e and in
the other states.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.geometry.so3 import exp_so3
from velod.optimizer.spikes import ACCEL_SPIKE, GYRO_SPIKE, mend_spikes
from velod.types import F64, I64


class InertialMemory:
    """Samples of the last few seconds; R_LB and s_L at those that have been integrated."""

    def __init__(self, memory_s: float) -> None:
        self._memory_ns = int(memory_s * 1e9)
        capacity = 4096
        self._t = np.empty(capacity, np.int64)
        self._accel = np.empty((capacity, 3))
        self._gyro = np.empty((capacity, 3))
        self._bias = np.zeros((capacity, 6))  # [b_a, b_w] used between sample k and k + 1
        self._R = np.empty((capacity, 3, 3))
        self._s = np.empty((capacity, 3))
        self._n = 0
        self._n_integrated = 0

    @property
    def t_ns(self) -> I64:
        """Times of the samples, shape (n,)."""
        return self._t[: self._n]

    @property
    def accel(self) -> F64:
        """Specific force, (n, 3), m/s^2, frame B."""
        return self._accel[: self._n]

    @property
    def gyro(self) -> F64:
        """Angular velocity, (n, 3), rad/s, frame B."""
        return self._gyro[: self._n]

    def covers(self, t_i: int, t_j: int) -> bool:
        """Whether there are samples at or before ``t_i`` and at or after ``t_j``."""
        return self._n >= 2 and self._t[0] <= t_i and self._t[self._n - 1] >= t_j

    def between(self, start_ns: int, end_ns: int) -> slice:
        """The samples with start_ns <= t < end_ns."""
        start, end = np.searchsorted(self.t_ns, (start_ns, end_ns))
        return slice(int(start), int(end))

    def append(self, t_ns: I64, accel: F64, gyro: F64) -> int:
        """Add samples, later than all before; forget what is older than the memory. Returns how many were mended."""
        m = len(t_ns)
        if self._n + m > len(self._t):
            self._forget()
        while self._n + m > len(self._t):
            self._grow()
        where = slice(self._n, self._n + m)
        self._t[where], self._accel[where], self._gyro[where] = t_ns, accel, gyro
        if self._n_integrated == 0 and m:
            self._R[0], self._s[0] = np.eye(3), 0.0
            self._n_integrated = 1
        self._n += m
        # what has been integrated stays; the newest sample has no successor yet to be judged by
        span = (max(self._n - m - 1, self._n_integrated), self._n - 1)
        return mend_spikes(self.accel, ACCEL_SPIKE, *span) + mend_spikes(self.gyro, GYRO_SPIKE, *span)

    def integrate_to(self, t_ns: int, b_a: F64, b_w: F64) -> None:
        """Extend R_LB and s_L to the first sample at or after ``t_ns``, with these biases."""
        first = self._n_integrated - 1
        last = min(int(np.searchsorted(self.t_ns, t_ns)), self._n - 1)
        if last <= first:
            return
        self._bias[first:last, :3], self._bias[first:last, 3:] = b_a, b_w
        _integrate_nominal(self._t, self._accel, self._gyro, self._bias, self._R, self._s, first, last)
        self._n_integrated = last + 1

    def at(self, t_ns: I64) -> tuple[F64, F64, F64]:
        """R_LB (m, 3, 3), s_L (m, 3) and the raw gyroscope (m, 3) at times within the integrated span."""
        m = len(t_ns)
        R, s, w = np.empty((m, 3, 3)), np.empty((m, 3)), np.empty((m, 3))
        self.write_at(t_ns, R, s, w)
        return R, s, w

    def write_at(self, t_ns: I64, R: F64, s: F64, w: F64) -> None:
        """``at`` into the arrays R (m, 3, 3), s (m, 3) and w (m, 3)."""
        n = self._n_integrated
        _nominal_at(
            self._t[:n], self._accel[:n], self._gyro[:n], self._bias[:n], self._R[:n], self._s[:n], t_ns, R, s, w
        )

    def rate_at(self, t_ns: int) -> tuple[F64, float]:
        """The gyroscope (3,) at ``t_ns`` between two samples, and its variance over its density's square, 1/s."""
        k = min(max(int(np.searchsorted(self.t_ns, t_ns, side="right")) - 1, 0), self._n - 2)
        span_ns = int(self._t[k + 1] - self._t[k])
        s = (t_ns - int(self._t[k])) / span_ns
        w: F64 = (1.0 - s) * self._gyro[k] + s * self._gyro[k + 1]
        return w, ((1.0 - s) ** 2 + s**2) / (span_ns * 1e-9)

    def shift(self, offset: F64) -> None:
        """Count s_L from another origin: s_L + offset."""
        self._s[: self._n_integrated] += offset

    def _forget(self) -> None:
        keep_from = int(np.searchsorted(self.t_ns, self._t[self._n - 1] - self._memory_ns)) if self._n else 0
        keep_from = max(0, min(keep_from, self._n_integrated - 1))
        kept = self._n - keep_from
        for column in (self._t, self._accel, self._gyro, self._bias, self._R, self._s):
            column[:kept] = column[keep_from : self._n].copy()
        self._n, self._n_integrated = kept, self._n_integrated - keep_from

    def _grow(self) -> None:
        for name in ("_t", "_accel", "_gyro", "_bias", "_R", "_s"):
            column = getattr(self, name)
            setattr(self, name, np.concatenate([column, np.zeros_like(column)]))


@njit(cache=True, nogil=True)
def continues(t_ns: I64, after_ns: int, gap_ns: int) -> bool:
    """Whether samples go on after ``after_ns`` without a step back or beyond ``gap_ns``; False for none."""
    before = after_ns
    for t in t_ns:
        if t <= before or t - before > gap_ns:
            return False
        before = t
    return len(t_ns) > 0


@njit(cache=True, nogil=True)
def _nominal_step(a0, a1, w0, w1, b, dt, R, s, phi, E, M):  # type: ignore[no-untyped-def]
    """R <- R Exp(int w), s <- s + int R (a - b_a), samples linear from 0 to 1; Simpson over two half steps."""
    for i in range(3):
        s[i] += dt / 6.0 * (R[i, 0] * (a0[0] - b[0]) + R[i, 1] * (a0[1] - b[1]) + R[i, 2] * (a0[2] - b[2]))
    for half in range(2):
        q = 0.75 if half == 0 else 0.25
        for i in range(3):
            phi[i] = (q * w0[i] + (1.0 - q) * w1[i] - b[3 + i]) * (0.5 * dt)
        exp_so3(phi, E)
        for i in range(3):
            for j in range(3):
                M[i, j] = R[i, 0] * E[0, j] + R[i, 1] * E[1, j] + R[i, 2] * E[2, j]
        for i in range(3):
            for j in range(3):
                R[i, j] = M[i, j]
        weight = dt * 4.0 / 6.0 if half == 0 else dt / 6.0
        r = 0.5 if half == 0 else 1.0
        for i in range(3):
            for j in range(3):
                s[i] += weight * R[i, j] * (a0[j] + r * (a1[j] - a0[j]) - b[j])


@njit(cache=True, nogil=True)
def _integrate_nominal(t_ns, accel, gyro, bias, R_out, s_out, first, last):  # type: ignore[no-untyped-def]
    R, s = R_out[first].copy(), s_out[first].copy()
    phi, E, M = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for k in range(first, last):
        dt = (t_ns[k + 1] - t_ns[k]) * 1e-9
        _nominal_step(accel[k], accel[k + 1], gyro[k], gyro[k + 1], bias[k], dt, R, s, phi, E, M)
        R_out[k + 1], s_out[k + 1] = R, s


@njit(cache=True, nogil=True)
def _nominal_at(t_ns, accel, gyro, bias, R_at, s_at, t_query, R_out, s_out, w_out):  # type: ignore[no-untyped-def]
    # Scratch instead of views of the rows: a view costs more than the arithmetic.
    phi, E, M, R, s = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    a0, w0, a1, w1, b = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(6)
    # the samples are found from those of the query before, which are near in general
    last = len(t_ns) - 2
    k = min(max(np.searchsorted(t_ns, t_query[0], side="right") - 1, 0), last) if len(t_query) else 0
    for m in range(len(t_query)):
        while k < last and t_ns[k + 1] <= t_query[m]:
            k += 1
        while k > 0 and t_ns[k] > t_query[m]:
            k -= 1
        share = (t_query[m] - t_ns[k]) / (t_ns[k + 1] - t_ns[k])
        for i in range(3):
            a0[i], w0[i], s[i] = accel[k, i], gyro[k, i], s_at[k, i]
            a1[i] = a0[i] + share * (accel[k + 1, i] - a0[i])
            w1[i] = w0[i] + share * (gyro[k + 1, i] - w0[i])
            b[i], b[3 + i] = bias[k, i], bias[k, 3 + i]
            for j in range(3):
                R[i, j] = R_at[k, i, j]
        dt = (t_query[m] - t_ns[k]) * 1e-9
        _nominal_step(a0, a1, w0, w1, b, dt, R, s, phi, E, M)
        for i in range(3):
            s_out[m, i], w_out[m, i] = s[i], w1[i]
            for j in range(3):
                R_out[m, i, j] = R[i, j]
