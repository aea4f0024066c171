"""The flow equations of one batch: a row for every event of which both flow and depth speak, made in one pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from velod.events.columns import readonly
from velod.geometry.so3 import vee_so3
from velod.optimizer.flow_equation import Measured, Rows, match, row_in_body, span
from velod.optimizer.inertial import InertialMemory
from velod.optimizer.small import median, multiply
from velod.types import F32, F64, I64, U16, U32, DepthBatch, FlowBatch

ACCELERATION_NS = 15_000_000
"""Accelerations are differences over this time: as short as the gyroscope's noise allows."""
MIN_INV_DEPTH = 1e-3
"""1/m, of the median depth of a batch."""


@dataclass(frozen=True, slots=True)
class Equations:
    """Rows of a batch on v_B and on e, and what belongs to them; valid until the next batch takes their memory."""

    on_velocity: Rows
    on_error: Rows  # with the same sigma as ``on_velocity``
    measured: Measured
    common: F64  # (m, 3), flow_equation.COMMON
    across: F64  # (m, 3) the rows on e of normals turned by a right angle
    depth_m: float  # median


@dataclass(frozen=True, slots=True)
class Prediction:
    """What is known of e before a batch: e (3,) at ``t_ns``, falling as gravity g_L (3,) says."""

    t_ns: int
    e_L: F64
    g_L: F64


class EquationMaker:
    """Makes Equations in memory that it keeps, for a rectified camera (f, cx, cy) at T_CB."""

    def __init__(self, camera: tuple[float, float, float], R_CB: F64, p_BC_B: F64) -> None:
        self._camera, self._R_CB, self._p_BC_B = camera, R_CB, p_BC_B
        self._motion = np.empty((3, 3))
        self._grow(512)

    def _grow(self, capacity: int) -> None:
        self._at_flow, self._at_depth, self._t_ns = (np.empty(capacity, np.int64) for _ in range(3))
        self._columns = np.empty((8, capacity))
        self._vectors = np.empty((6, capacity, 3))
        self._R_LB = np.empty((capacity, 3, 3))

    def make(
        self,
        flow: FlowBatch,
        depth: DepthBatch,
        memory: InertialMemory,
        earliest_ns: int,
        known: Prediction | None,
        late_ns: int = 0,
    ) -> Equations:
        """The rows of all events since ``earliest_ns``, which the memory covers, ``late_ns`` before their stamps.

        ``known`` gives the rows of common errors; they are 0 without it, and where the memory does not reach back.
        """
        if len(flow.index) > len(self._t_ns):
            self._grow(2 * len(flow.index))
        m = _usable(
            readonly(flow.index, np.uint16), readonly(depth.index, np.uint16), readonly(flow.age, np.uint32),
            flow.t_ns - late_ns, earliest_ns, self._at_flow, self._at_depth, self._t_ns,
        )  # fmt: skip
        at_flow, at_depth, t_ns = self._at_flow[:m], self._at_depth[:m], self._t_ns[:m]
        R_LB = self._R_LB[:m]
        a_B, b_B, a_L, across, common, s_L = self._vectors[:, :m]
        w_B = common  # until it is written
        memory.write_at(t_ns, R_LB, s_L, w_B)
        _fill(
            readonly(flow.x, np.float32), readonly(flow.y, np.float32), readonly(flow.n, np.float32),
            readonly(flow.speed, np.float32), readonly(flow.sigma, np.float32), readonly(depth.inv_depth, np.float32),
            readonly(depth.sigma, np.float32), at_flow, at_depth, self._camera, self._R_CB, self._p_BC_B,
            R_LB, s_L, w_B, self._columns, self._vectors,
        )  # fmt: skip
        z_v, z_e, speed, sigma, translational, depth_share, row_sigma, inv_depth = self._columns[:, :m]
        depth_m = 1.0 / max(median(inv_depth), MIN_INV_DEPTH) if m else 0.0
        if m and known is not None and self._note_motion(span(t_ns)[0], memory, known):
            _fill_common(t_ns, a_B, b_B, a_L, s_L, self._motion, known.t_ns, known.e_L, known.g_L, common)
        else:
            common[:] = 0.0
        measured = Measured(speed, sigma, translational, depth_share)
        on_velocity, on_error = Rows(t_ns, z_v, a_B, b_B, row_sigma), Rows(t_ns, z_e, a_L, b_B, row_sigma)
        return Equations(on_velocity, on_error, measured, common, across, depth_m)

    def _note_motion(self, t_ns: int, memory: InertialMemory, known: Prediction) -> bool:
        """Angular velocity and both accelerations shortly before ``t_ns``; False where the memory does not reach."""
        before = t_ns - np.array([2, 1, 0]) * ACCELERATION_NS
        if before[0] < memory.t_ns[0]:
            return False
        R_LB, s_L, _ = memory.at(before)
        _motion(before, R_LB, s_L, known.t_ns, known.e_L, known.g_L, self._motion)
        return True


@njit(cache=True, nogil=True)
def _usable(
    flow_index: U16, depth_index: U16, age: U32, end_ns: int, earliest_ns: int, at_flow: I64, at_depth: I64, t_ns: I64
) -> int:
    """Positions in both columns of the events since ``earliest_ns``, and their times; returns how many."""
    n = 0
    for k in range(match(flow_index, depth_index, at_flow, at_depth)):
        t = end_ns - np.int64(age[at_flow[k]])
        if t >= earliest_ns:
            at_flow[n], at_depth[n], t_ns[n] = at_flow[k], at_depth[k], t
            n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(
    x: F32,
    y: F32,
    n: F32,
    speed: F32,
    sigma: F32,
    inv_depth: F32,
    sigma_inv: F32,
    at_flow: I64,
    at_depth: I64,
    camera: tuple[float, float, float],
    R_CB: F64,
    p: F64,
    R_LB: F64,
    s_L: F64,
    w_B: F64,
    columns: F64,
    vectors: F64,
) -> None:
    """Of ``EquationMaker.make``'s columns (8, n) and vectors (6, n, 3) the first rows, as they are named there."""
    z_v, z_e, own_speed, own_sigma = columns[0], columns[1], columns[2], columns[3]
    translational, depth_share, own_inv_depth = columns[4], columns[5], columns[7]
    a_B, b_B, a_L, across = vectors[0], vectors[1], vectors[2], vectors[3]
    f, cx, cy = camera
    for k in range(at_flow.size):
        i, rho = at_flow[k], np.float64(inv_depth[at_depth[k]])
        u, v = np.float64(x[i]) - cx, np.float64(y[i]) - cy
        nx, ny = np.float64(n[i, 0]), np.float64(n[i, 1])
        a, b = row_in_body(u, v, f, nx, ny, rho, R_CB, p)
        turned, _ = row_in_body(u, v, f, -ny, nx, rho, R_CB, p)
        own_speed[k], own_sigma[k], own_inv_depth[k] = speed[i], sigma[i], rho
        depth_share[k] = sigma_inv[at_depth[k]] / rho
        # Eq. 4: |x_n| - n^T B w = (n^T A / Z) v
        z = np.float64(speed[i]) - (b[0] * w_B[k, 0] + b[1] * w_B[k, 1] + b[2] * w_B[k, 2])
        z_v[k] = translational[k] = z
        a_B[k, 0], a_B[k, 1], a_B[k, 2] = a
        b_B[k, 0], b_B[k, 1], b_B[k, 2] = b
        # v_B = R_BL (s_L + e)
        for r in range(3):
            r0, r1, r2 = R_LB[k, r, 0], R_LB[k, r, 1], R_LB[k, r, 2]
            row = r0 * a[0] + r1 * a[1] + r2 * a[2]
            a_L[k, r] = row
            across[k, r] = r0 * turned[0] + r1 * turned[1] + r2 * turned[2]
            z -= row * s_L[k, r]
        z_e[k] = z


@njit(cache=True, nogil=True)
def _motion(t_ns: I64, R_LB: F64, s_L: F64, known_ns: int, e_L: F64, g_L: F64, out: F64) -> None:
    """w_B, d v_B / dt and d w_B / dt, the rows of out (3, 3), by central differences over three moments."""
    dt = (t_ns[1] - t_ns[0]) * 1e-9
    turn, first, second = np.empty((3, 3)), np.empty(3), np.empty(3)
    multiply(R_LB[0].T, R_LB[1], turn)
    vee_so3(turn, first)  # of so small a turn the rotation vector, to the third order
    multiply(R_LB[1].T, R_LB[2], turn)
    vee_so3(turn, second)
    for i in range(3):
        out[0, i] = (first[i] + second[i]) / (2.0 * dt)
        out[2, i] = (second[i] - first[i]) / dt**2
        out[1, i] = 0.0
        for r in range(3):
            for k, sign in ((0, -1.0), (2, 1.0)):
                v_L = s_L[k, r] + e_L[r] - (t_ns[k] - known_ns) * 1e-9 * g_L[r]
                out[1, i] += sign * R_LB[k, r, i] * v_L / (2.0 * dt)


@njit(cache=True, nogil=True)
def _fill_common(
    t_ns: I64, a_B: F64, b_B: F64, a_L: F64, s_L: F64, motion: F64, known_ns: int, e_L: F64, g_L: F64, out: F64
) -> None:
    """Rows (m, 3) of the errors that all flows have in common, from the predicted flow and its rate of change.

    None of them may come from the noise that is in z: a product of both would look like a common error. So velocity
    and gravity are those known before the batch, and ``motion`` is that of before it.
    """
    for k in range(t_ns.size):
        dt = (t_ns[k] - known_ns) * 1e-9
        translational = rotational = rate = 0.0
        for i in range(3):
            translational += a_L[k, i] * (s_L[k, i] + e_L[i] - dt * g_L[i])
            rotational += b_B[k, i] * motion[0, i]
            rate += a_B[k, i] * motion[1, i] + b_B[k, i] * motion[2, i]
        out[k, 0], out[k, 1], out[k, 2] = translational + rotational, -rate, translational
