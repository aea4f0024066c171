"""Do the rows and the clocks of the two cameras agree? Seen from the disparities of neighbouring edges.

Two edges of one surface, close together, have nearly one disparity, whichever way they lean. An error of the rig
parts them: a right image that lies ``row_px`` lower is matched along the row at another place of a leaning edge, and
a right clock that is ``clock_s`` late sees every edge where it was before. So, over pairs of neighbours,

    d_i - d_j = clock_s (u_i - u_j) - row_px (k_i - k_j),    u = u_x + u_y k,  k = n_y / n_x,

where u is the speed at which the edge runs along the row and k its lean. What is nearer has the larger disparity and
moves faster as well, which must not pass for a clock: u is that of the image motion of Eq. 1 which fits the batch's
flows, at one disparity for both neighbours. Depth that differs between neighbours is then noise of either sign; pairs
across a step of depth have little weight. Where all edges run along the rows equally fast (a sideways slide) the
clocks cannot be told: then nothing is said of them.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numba import njit

from velod.geometry.camera import motion_field_rows
from velod.geometry.cholesky import backward, factorise, forward
from velod.optimizer.flow_equation import pairs
from velod.optimizer.small import median
from velod.types import F64, DepthBatch, FlowBatch

NEAR_PX = 12.0
MIN_NORMAL_X = 0.3
"""Edges flatter than this have too uncertain a place on the row."""
MAX_PAIRS = 4096
MIN_PAIRS = 30
ROUNDS = 5
MOTION_ROUNDS, MOTION_OUTLIER = 4, 3.0
"""Rounds in which the image motion is fitted anew without the flows that are so many (robust) sigmas off."""
LEAST_PIVOT = 1e-6
"""A part of the motion that moves the flows by less, of what it would without the others, is not determined."""
HELD = 120
"""Batches that count, a few seconds."""
MIN_BATCHES = 12
SIGNAL = 2.0
"""Spread of u (variance) over what errors of the motion explain, above which it tells of the clocks ..."""
MOTION_SHARE = 0.05
"""... of which so large a share of u is no noise of the flows."""
LEAN_PX = 0.02
"""Disparities of edges that lean differently may differ by so much for no fault of the rig."""
REPEATED = 2.0
"""Batches that follow each other see the same edges: their scatter is multiplied by this."""
LEAST_ROW_PX = 1e-3


@dataclass(frozen=True, slots=True)
class StereoOffsets:
    """Right against left; a sigma is inf where nothing can be said."""

    clock_s: float  # the right camera's stamps are so much later
    clock_sigma_s: float
    row_px: float  # the right image lies so much lower
    row_sigma_px: float


@dataclass(frozen=True, slots=True)
class _Sums:
    """Of one batch: normal equations of [clock_s, row_px], the part of H[0, 0] that noise explains, all weights."""

    H: F64  # (2, 2)
    h: F64  # (2,)
    noise: float
    weight: float


class StereoCheck:
    """Takes batches of flow and depth, and says what they say of the rig."""

    def __init__(self, camera: tuple[float, float, float]) -> None:
        """``camera``: f, cx, cy of the rectified left image, px."""
        self._camera = camera
        self._held: deque[_Sums] = deque(maxlen=HELD)
        self._buffer = np.empty((MAX_PAIRS, 5))

    def add(self, flow: FlowBatch, depth: DepthBatch) -> None:
        """Take in a batch; one without enough pairs of neighbouring edges says nothing."""
        at_flow, at_depth = pairs(flow.index, depth.index)
        n = flow.n[at_flow].astype(np.float64)
        used = (depth.refined[at_depth] > 0) & (np.abs(n[:, 0]) > MIN_NORMAL_X)
        at_flow, at_depth, n = at_flow[used], at_depth[used], n[used]
        x, y, disparity = (
            c.astype(np.float64) for c in (flow.x[at_flow], flow.y[at_flow], depth.disparity[at_depth])
        )
        nA, nB = motion_field_rows(x, y, *self._camera, n)
        rows = np.hstack([disparity[:, None] * nA, nB])
        fit = _fit_motion(rows, flow.speed[at_flow].astype(np.float64), flow.sigma[at_flow].astype(np.float64))
        if fit is None:
            return
        motion, root = fit
        along_row = 1.0 / n[:, :1]
        count = _neighbours(
            x, y, n, disparity, along_row[:, 0] * (nA @ motion[:3]), along_row[:, 0] * (nB @ motion[3:]),
            along_row * (rows @ root), self._buffer,
        )  # fmt: skip
        if count < MIN_PAIRS:
            return
        H, h = np.zeros((2, 2)), np.zeros(2)
        self._held.append(_Sums(H, h, *_robust_sums(self._buffer[:count], H, h)))

    def offsets(self) -> StereoOffsets | None:
        """What the newest batches say together; None before there are enough of them."""
        if len(self._held) < MIN_BATCHES:
            return None
        H = np.array([s.H for s in self._held])
        h = np.array([s.h for s in self._held])
        total = H.sum(axis=0)
        noise = sum(s.noise for s in self._held)
        if total[0, 0] < SIGNAL * noise or not np.linalg.det(total) > 1e-3 * total[0, 0] * total[1, 1]:
            row, sigma = _solve(H[:, 1:, 1:], h[:, 1:])
            return StereoOffsets(0.0, math.inf, float(row[0]), float(max(sigma[0], LEAST_ROW_PX)))
        x, sigma = _solve(H, h)
        spread = math.sqrt(total[0, 0] / sum(s.weight for s in self._held))  # of u, px/s
        clock_sigma_s = math.hypot(sigma[0], LEAN_PX / spread)
        return StereoOffsets(float(x[0]), clock_sigma_s, float(x[1]), float(max(sigma[1], LEAST_ROW_PX)))


def _solve(H: F64, h: F64) -> tuple[F64, F64]:
    """Solution (k,) of the sums of H (m, k, k) and h (m, k), and its sigma from how the batches differ."""
    inverse = np.linalg.inv(H.sum(axis=0))
    x = inverse @ h.sum(axis=0)
    g = h - H @ x
    return x, np.sqrt(REPEATED * np.diag(inverse @ (g.T @ g) @ inverse))


def _fit_motion(rows: F64, speed: F64, sigma: F64) -> tuple[F64, F64] | None:
    """Motion (6,) that explains the speeds (m,) by ``rows`` (m, 6), and a root (6, 6) of its covariance.

    None where the flows do not determine it.
    """
    motion, L, scale = np.zeros(6), np.empty((6, 6)), np.empty(6)
    sigmas = _reweighted_motion(rows, speed, 1.0 / sigma, motion, L, scale)
    if not sigmas > 0.0:
        return None
    root: F64 = sigmas * np.linalg.inv(L).T / scale[:, None]
    return motion, root


@njit(cache=True, nogil=True)
def _reweighted_motion(rows: F64, speed: F64, per_sigma: F64, motion: F64, L: F64, scale: F64) -> float:
    """Rounds of least squares without outliers; returns the robust size of a residual in sigmas, 0 where it fails.

    The normal equations, ``scale`` (6,) taken out on both sides, are L L^T (6, 6).
    """
    m, n = rows.shape
    off, size, limit = np.zeros(m), np.empty(m), 1.0
    for _ in range(MOTION_ROUNDS):
        L[:] = 0.0
        motion[:] = 0.0
        kept = 0
        for k in range(m):
            if off[k] < limit:
                kept += 1
                w = per_sigma[k] * per_sigma[k]
                for i in range(n):
                    motion[i] += w * rows[k, i] * speed[k]
                    for j in range(i + 1):
                        L[i, j] += w * rows[k, i] * rows[k, j]
        for i in range(n):
            scale[i] = math.sqrt(L[i, i])
        if kept < MIN_PAIRS or not scale.min() > 0.0:
            return 0.0
        for i in range(n):
            motion[i] /= scale[i]
            for j in range(i + 1):
                L[i, j] /= scale[i] * scale[j]
        factorise(L)
        for i in range(n):
            if not L[i, i] > LEAST_PIVOT:
                return 0.0
        forward(L, motion)
        backward(L, motion)
        for i in range(n):
            motion[i] /= scale[i]
        for k in range(m):
            predicted = 0.0
            for i in range(n):
                predicted += rows[k, i] * motion[i]
            off[k] = abs(speed[k] - predicted) * per_sigma[k]
            size[k] = off[k]
        sigmas = max(1.0, 1.5 * median(size))
        limit = MOTION_OUTLIER * sigmas
    return sigmas


@njit(cache=True, nogil=True)
def _neighbours(x: F64, y: F64, n: F64, disparity: F64, per_px: F64, turning: F64, root: F64, out: F64) -> int:
    """Rows (d_i - d_j, u_i - u_j, -(k_i - k_j), sigma shape, variance of the second by noise); returns how many.

    u is ``turning`` (m,) + disparity ``per_px`` (m,), px/s, its covariance ``root root^T``, (m, 6).
    """
    m = 0
    for i in range(x.size):
        k_i = n[i, 1] / n[i, 0]
        for j in range(i):
            if m < out.shape[0] and abs(x[i] - x[j]) < NEAR_PX and abs(y[i] - y[j]) < NEAR_PX:
                out[m, 0] = disparity[i] - disparity[j]
                out[m, 1] = turning[i] - turning[j] + 0.5 * (disparity[i] + disparity[j]) * (per_px[i] - per_px[j])
                out[m, 2] = n[j, 1] / n[j, 0] - k_i
                # The sigma of a refined disparity goes with 1 / n_x.
                out[m, 3] = math.hypot(1.0 / n[i, 0], 1.0 / n[j, 0])
                u = turning[i] + disparity[i] * per_px[i]
                out[m, 4] = (MOTION_SHARE * u) ** 2
                for k in range(root.shape[1]):
                    out[m, 4] += (root[i, k] - root[j, k]) ** 2
                m += 1
    return m


@njit(cache=True, nogil=True)
def _robust_sums(rows: F64, H: F64, h: F64) -> tuple[float, float]:
    """Normal equations of the rows by ``_neighbours``, weighted by their own solution.

    Returns H[0, 0] of noise, and the sum of the weights.
    """
    size = np.empty(rows.shape[0])
    clock, row, noise, weight = 0.0, 0.0, 0.0, 0.0
    for _ in range(ROUNDS):
        for i in range(size.size):
            size[i] = abs(rows[i, 0] - clock * rows[i, 1] - row * rows[i, 2]) / rows[i, 3]
        scale = max(2.0 * np.median(size), 1e-3)
        H[:] = 0.0
        h[:] = 0.0
        noise = weight = 0.0
        for i in range(size.size):
            # Cauchy's weight: a step of depth counts little, but a first solution far off still finds the way.
            w = 1.0 / (1.0 + (size[i] / scale) ** 2) / (rows[i, 3] * scale) ** 2
            H[0, 0] += w * rows[i, 1] * rows[i, 1]
            H[0, 1] += w * rows[i, 1] * rows[i, 2]
            H[1, 1] += w * rows[i, 2] * rows[i, 2]
            h[0] += w * rows[i, 1] * rows[i, 0]
            h[1] += w * rows[i, 2] * rows[i, 0]
            noise += w * rows[i, 4]
            weight += w
        H[1, 0] = H[0, 1]
        det = H[0, 0] * H[1, 1] - H[0, 1] * H[0, 1]
        if not det > 1e-9 * H[0, 0] * H[1, 1]:
            break
        clock = (H[1, 1] * h[0] - H[0, 1] * h[1]) / det
        row = (H[0, 0] * h[1] - H[0, 1] * h[0]) / det
    return noise, weight
