"""The flow equation (Eq. 4) of a batch as rows that are linear in the velocity.

With depth in inverse form the equation reads

    |x_n| - n^T B w = (n^T A / Z) v,

and, at a known angular velocity less its bias, z = a . e - b . b_w with z = |x_n| - b . w - a . s, where a and b are
rows in the frame of the estimated error e.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from velod.events.columns import readonly
from velod.geometry.camera import motion_field_row
from velod.geometry.so3 import Row
from velod.types import F32, F64, I64, U16

PREDICTED_SHARE = (0.3, 3.0)
"""Bounds on predicted over measured flow where a sigma is scaled by it."""
COMMON = ("flow scale", "delay", "depth scale")
"""What all flows of a moment have wrong in common: speeds too large by a share, stamps too late by so many seconds,
inverse depths too large by a share. They last: the window estimates them beside the velocity."""
MODEL_SIGMA_PX_S = 2.0
"""Flow error that neither fit nor depth accounts for."""


@dataclass(frozen=True, slots=True)
class Rows:
    """One row per flow: z = a . e - b . b_w, with sigma; ``t_ns`` increasing is not required."""

    t_ns: I64  # (m,)
    z: F64  # (m,) px/s
    a: F64  # (m, 3) px/m
    b: F64  # (m, 3) px
    sigma: F64  # (m,) px/s


@dataclass(frozen=True, slots=True)
class Measured:
    """What the sigma of a row follows from, (m,) each."""

    speed: F64  # normal flow, px/s
    sigma: F64  # of speed, px/s
    translational: F64  # speed less what rotation explains, px/s
    depth_share: F64  # sigma of the inverse depth as a share of it


def body_rows(
    xy: tuple[F32, F32],
    n: F32,
    inv_depth: F32,
    camera: tuple[float, float, float],
    R_CB: F64,
    p_BC_B: F64,
) -> tuple[F64, F64]:
    """n^T A / Z and n^T B of Eq. 4 as rows on v_B and w_B, both (m, 3), for the camera at ``p_BC_B`` in B.

    ``camera`` is (f, cx, cy) of the rectified image. v_C = R_CB (v_B + w_B x p_BC_B): the lever arm adds p x a to b.
    """
    f, cx, cy = camera
    a_B, b_B = np.empty((len(xy[0]), 3)), np.empty((len(xy[0]), 3))
    _rows_in_body(
        xy[0].astype(np.float64) - cx, xy[1].astype(np.float64) - cy, f, n.astype(np.float64),
        inv_depth.astype(np.float64), R_CB, p_BC_B, a_B, b_B,
    )  # fmt: skip
    return a_B, b_B


def on_velocity(t_ns: I64, speed: F64, a_B: F64, b_B: F64, w_B: F64) -> Rows:
    """Rows on v_B and b_w from those of ``body_rows`` and the measured w_B (m, 3); sigma is left to be set."""
    m = len(t_ns)
    z = np.empty(m)
    _less_product(speed, b_B, w_B, z)
    return Rows(t_ns, z, a_B, b_B, np.empty(m))


def sigmas(measured: Measured, residual: F64) -> F64:
    """Standard deviation of a row, px/s, (m,): fit, model, and the depth's share of the translational flow.

    They are those of the flow that a velocity predicts, the measured one less ``residual`` (m,): a weight that
    follows the measured speed would believe slow flows more than fast ones, and bias the velocity.
    """
    out = np.empty_like(residual)
    fill_sigmas(measured.speed, measured.sigma, measured.translational, measured.depth_share, residual, out)
    return out


def less_known(rows: Rows, c: F64, common: F64, slope: F64, e: F64, t_ns: int) -> Rows:
    """The rows on what differs from ``e`` (3,) at ``t_ns``, where ``common`` (3,) and the slope of e (3,) are known.

    ``c`` (m, 3) are the rows of common errors. The sigma is that of ``rows``, the same array.
    """
    z = np.empty_like(rows.z)
    _less_known(rows.t_ns, rows.z, rows.a, c, common, slope, e, t_ns, z)
    return Rows(rows.t_ns, z, rows.a, rows.b, rows.sigma)


def pairs(flow_index: U16, depth_index: U16) -> tuple[I64, I64]:
    """Positions in both of the values that two increasing columns share."""
    at_flow = np.empty(min(len(flow_index), len(depth_index)), np.int64)
    at_depth = np.empty_like(at_flow)
    n = match(readonly(flow_index, np.uint16), readonly(depth_index, np.uint16), at_flow, at_depth)
    return at_flow[:n], at_depth[:n]


@njit(cache=True, nogil=True)
def span(t_ns: I64) -> tuple[int, int]:
    """The first and the last of some times (m,), m > 0, in any order."""
    first = last = t_ns[0]
    for t in t_ns:
        first, last = min(first, t), max(last, t)
    return first, last


@njit(cache=True, nogil=True)
def match(left: U16, right: U16, at_left: I64, at_right: I64) -> int:
    """``pairs`` into at_left and at_right; returns how many."""
    i = j = n = 0
    while i < left.size and j < right.size:
        if left[i] < right[j]:
            i += 1
        elif left[i] > right[j]:
            j += 1
        else:
            at_left[n], at_right[n] = i, j
            i, j, n = i + 1, j + 1, n + 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def row_in_body(u: float, v: float, f: float, nx: float, ny: float, rho: float, R_CB: F64, p: F64) -> tuple[Row, Row]:
    """n^T A rho R_CB and n^T B R_CB + p x a, at (u, v) px from the principal point (Eq. 4)."""
    (a0, a1, a2), (b0, b1, b2) = motion_field_row(u, v, f, nx, ny)
    a = _times(rho * a0, rho * a1, rho * a2, R_CB)
    b = _times(b0, b1, b2, R_CB)
    across = p[1] * a[2] - p[2] * a[1], p[2] * a[0] - p[0] * a[2], p[0] * a[1] - p[1] * a[0]
    return a, (b[0] + across[0], b[1] + across[1], b[2] + across[2])


@njit(cache=True, nogil=True, error_model="numpy")
def _times(x: float, y: float, z: float, R: F64) -> Row:
    """The row (x, y, z) R."""
    return (
        x * R[0, 0] + y * R[1, 0] + z * R[2, 0],
        x * R[0, 1] + y * R[1, 1] + z * R[2, 1],
        x * R[0, 2] + y * R[1, 2] + z * R[2, 2],
    )


@njit(cache=True, nogil=True)
def _rows_in_body(u: F64, v: F64, f: float, n: F64, inv_depth: F64, R_CB: F64, p: F64, a: F64, b: F64) -> None:
    for k in range(u.size):
        a_k, b_k = row_in_body(u[k], v[k], f, n[k, 0], n[k, 1], inv_depth[k], R_CB, p)
        a[k, 0], a[k, 1], a[k, 2] = a_k
        b[k, 0], b[k, 1], b[k, 2] = b_k


@njit(cache=True, nogil=True, error_model="numpy")
def fill_sigmas(speed: F64, sigma: F64, translational: F64, depth_share: F64, residual: F64, out: F64) -> None:
    """``sigmas`` into ``out``."""
    low, high = PREDICTED_SHARE
    for k in range(speed.size):
        share = min(max((speed[k] - residual[k]) / speed[k], low), high)
        from_fit = sigma[k] * share
        from_depth = (translational[k] - residual[k]) * depth_share[k]
        out[k] = math.sqrt(from_fit * from_fit + MODEL_SIGMA_PX_S**2 + from_depth * from_depth)


@njit(cache=True, nogil=True)
def _less_known(t_ns: I64, z: F64, a: F64, c: F64, common: F64, slope: F64, e: F64, at_ns: int, out: F64) -> None:
    for k in range(z.size):
        dt = (t_ns[k] - at_ns) * 1e-9
        out[k] = z[k]
        for i in range(3):
            out[k] -= c[k, i] * common[i] + a[k, i] * (e[i] + dt * slope[i])


@njit(cache=True, nogil=True)
def _less_product(z: F64, a: F64, x: F64, out: F64) -> None:
    """out = z - a . x, row by row."""
    for k in range(z.size):
        out[k] = z[k] - (a[k, 0] * x[k, 0] + a[k, 1] * x[k, 1] + a[k, 2] * x[k, 2])
