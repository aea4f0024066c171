"""IMU samples in memory, and the motion integrated from them: the frame L.

L is B at the first sample, carried on by the gyroscope alone: R_LB(t). ``s_L(t)`` is the integral of
R_LB (a - b_a), gravity included; the velocity is v_B = R_BL (s_L + e), whose error e is what the spline models. R_LB
and s_L are fixed functions of time once integrated: whatever is wrong with them (bias, gravity, start) is in e and in
the other states.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.events.sae import NEVER
from velod.geometry.so3 import exp_rows
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
        self._asked_ns, self._answer = NEVER, (np.eye(3), np.zeros(3))

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

    def frame_at(self, t_ns: int) -> tuple[F64, F64]:
        """R_LB (3, 3) and s_L (3,) at a moment within the integrated span; the last answer is remembered."""
        if t_ns != self._asked_ns:
            R, s, _ = self.at(np.array([t_ns]))
            self._asked_ns, self._answer = t_ns, (R[0], s[0])
        return self._answer

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
        self._asked_ns = NEVER

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
def _nominal_step(R, s, k, a0, a1, w0, w1, dt, R_out, s_out, m):  # type: ignore[no-untyped-def]
    """R Exp(int w) and s + int R a from row ``k`` of R and s into row ``m`` of R_out and s_out.

    Specific force and angular velocity, less their biases, go linearly from 0 to 1; Simpson over two half steps.
    """
    h0, h1 = 0.375 * dt, 0.125 * dt
    E0, E1, E2 = exp_rows(h0 * w0[0] + h1 * w1[0], h0 * w0[1] + h1 * w1[1], h0 * w0[2] + h1 * w1[2])
    F0, F1, F2 = exp_rows(h1 * w0[0] + h0 * w1[0], h1 * w0[1] + h0 * w1[1], h1 * w0[2] + h0 * w1[2])
    h = dt / 6.0
    for i in range(3):
        r0, r1, r2 = R[k, i, 0], R[k, i, 1], R[k, i, 2]
        total = r0 * a0[0] + r1 * a0[1] + r2 * a0[2]
        # the middle counts four times, with half of both forces
        m0 = r0 * E0[0] + r1 * E1[0] + r2 * E2[0]
        m1 = r0 * E0[1] + r1 * E1[1] + r2 * E2[1]
        m2 = r0 * E0[2] + r1 * E1[2] + r2 * E2[2]
        total += 2.0 * (m0 * (a0[0] + a1[0]) + m1 * (a0[1] + a1[1]) + m2 * (a0[2] + a1[2]))
        r0 = m0 * F0[0] + m1 * F1[0] + m2 * F2[0]
        r1 = m0 * F0[1] + m1 * F1[1] + m2 * F2[1]
        r2 = m0 * F0[2] + m1 * F1[2] + m2 * F2[2]
        total += r0 * a1[0] + r1 * a1[1] + r2 * a1[2]
        R_out[m, i, 0], R_out[m, i, 1], R_out[m, i, 2] = r0, r1, r2
        s_out[m, i] = s[k, i] + h * total


@njit(cache=True, nogil=True)
def _less(values, k, bias, part):  # type: ignore[no-untyped-def]
    """Row ``k`` of values less the part from column ``part`` on of that of its bias."""
    return values[k, 0] - bias[0 + part], values[k, 1] - bias[1 + part], values[k, 2] - bias[2 + part]


@njit(cache=True, nogil=True)
def _between(v0, v1, share):  # type: ignore[no-untyped-def]
    """The ``share`` of the way from v0 to v1."""
    return v0[0] + share * (v1[0] - v0[0]), v0[1] + share * (v1[1] - v0[1]), v0[2] + share * (v1[2] - v0[2])


@njit(cache=True, nogil=True)
def _integrate_nominal(t_ns, accel, gyro, bias, R, s, first, last):  # type: ignore[no-untyped-def]
    for k in range(first, last):
        dt = (t_ns[k + 1] - t_ns[k]) * 1e-9
        b = bias[k]
        a0, a1 = _less(accel, k, b, 0), _less(accel, k + 1, b, 0)
        _nominal_step(R, s, k, a0, a1, _less(gyro, k, b, 3), _less(gyro, k + 1, b, 3), dt, R, s, k + 1)


@njit(cache=True, nogil=True)
def _nominal_at(t_ns, accel, gyro, bias, R_at, s_at, t_query, R_out, s_out, w_out):  # type: ignore[no-untyped-def]
    # the samples are found from those of the query before, which are near in general
    last = len(t_ns) - 2
    k = min(max(np.searchsorted(t_ns, t_query[0], side="right") - 1, 0), last) if len(t_query) else 0
    for m in range(len(t_query)):
        while k < last and t_ns[k + 1] <= t_query[m]:
            k += 1
        while k > 0 and t_ns[k] > t_query[m]:
            k -= 1
        share = (t_query[m] - t_ns[k]) / (t_ns[k + 1] - t_ns[k])
        b = bias[k]
        a0, w0 = _less(accel, k, b, 0), _less(gyro, k, b, 3)
        a1 = _between(a0, _less(accel, k + 1, b, 0), share)
        w1 = _between(w0, _less(gyro, k + 1, b, 3), share)
        dt = (t_query[m] - t_ns[k]) * 1e-9
        _nominal_step(R_at, s_at, k, a0, a1, w0, w1, dt, R_out, s_out, m)
        w_out[m, 0], w_out[m, 1], w_out[m, 2] = w1[0] + b[3], w1[1] + b[4], w1[2] + b[5]
