"""True depth along any ray at any moment: what stages and the floor are judged by.

A simulator casts rays into its scene (``velod.sim.true_depth``). A recording that holds depth images now and then,
and the true motion, gives nearly as much: the ray is followed through the surface that the nearest image shows.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numba import njit

from velod.eval.metrics import interpolated
from velod.geometry.calibration import Calibration
from velod.geometry.rectify import Rectification
from velod.geometry.so3 import matrix_from_quaternion
from velod.io.model import DepthTruth, Truth
from velod.types import F32, F64, I64

JUMP = 0.15
"""Depths that differ by this share of their mean do not belong to one surface."""


class TrueDepth(Protocol):
    """Depth along rays of the rectified left camera C; its frame is that of FlowBatch and DepthBatch."""

    @property
    def how(self) -> str:
        """How the truth is looked up, for people."""
        ...

    def __call__(self, t_ns: I64, rays: F64, shift_m: float = 0.0) -> F64:
        """Depth (m, k), m along z of C, at times ``t_ns`` (m,) along ``rays`` (m, k, 2), x and y on its plane Z = 1.

        ``shift_m``: the camera moved so far along C's x axis. NaN where nothing is known.
        """
        ...


class SceneTruthError(ValueError):
    """A truth that depths cannot be looked up in; the text says why."""


class DepthImages:
    """Depth images of the left camera, as a static scene's surface: each ray is followed to where it meets it.

    From the image nearest in time, else from its neighbour; unknown (NaN) where neither shows the place, or only
    beside a jump of depth. Exact where surfaces are plane, as inverse depth is linear between pixels.
    """

    how = "depth images, the nearest in time, met by each event's ray at its own time"

    def __init__(
        self, depth: DepthTruth, truth: Truth, calibration: Calibration, rectification: Rectification
    ) -> None:
        """Raises SceneTruthError for a camera with distortion, and without a true position."""
        if truth.p_WB is None:
            raise SceneTruthError("depth images cannot be used without the true position")
        if calibration.left.model != "none":
            raise SceneTruthError("depth images are used of undistorted cameras only")
        self._depth, self._truth, self._rectification = depth, truth, rectification
        camera = calibration.left
        self._pinhole = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        self._inverse: F32 = 1.0 / depth.left
        self._R_WL, self._p_WL = self._poses(depth.t_ns, rectification.R_rect_left.T @ rectification.R_CB)

    def __call__(self, t_ns: I64, rays: F64, shift_m: float = 0.0) -> F64:
        """As TrueDepth says: by the image nearest in time, or by the next where that one does not tell."""
        R_WC, p_WC = self._poses(t_ns, self._rectification.R_CB)
        p_WC = p_WC + shift_m * R_WC[:, :, 0]
        order = np.argsort(np.abs(t_ns[:, None] - self._depth.t_ns), axis=1, kind="stable")[:, :2]
        found = np.full(rays.shape[:2], np.nan)
        for image in np.ascontiguousarray(order.T):
            R_WL = self._R_WL[image]
            R_LC = R_WL.transpose(0, 2, 1) @ R_WC
            p_LC = np.einsum("nji,nj->ni", R_WL, p_WC - self._p_WL[image])
            met = np.full_like(found, np.nan)
            _follow_each(self._inverse, image, self._pinhole, R_LC, p_LC, np.ascontiguousarray(rays), JUMP, met)
            found = np.where(np.isnan(found), met, found)
        return found

    def _poses(self, t_ns: I64, R_CB: F64) -> tuple[F64, F64]:
        """R_WC (n, 3, 3) and p_WC (n, 3); between the samples of the truth by chords, 1e-5 rad off at 1 kHz."""
        assert self._truth.p_WB is not None, "checked at the start"
        inside = np.clip(t_ns, self._truth.t_ns[0], self._truth.t_ns[-1])
        signs = np.sign(np.sum(self._truth.q_WB_xyzw[1:] * self._truth.q_WB_xyzw[:-1], axis=1))
        continuous = self._truth.q_WB_xyzw * np.concatenate([[1.0], np.cumprod(signs)])[:, None]
        q = interpolated(self._truth.t_ns, continuous, inside)
        R_WB = matrix_from_quaternion(q / np.linalg.norm(q, axis=1, keepdims=True))
        p_WB = interpolated(self._truth.t_ns, self._truth.p_WB, inside)
        return R_WB @ R_CB.T, p_WB + R_WB @ self._rectification.p_BC_B


def rays(rect: Rectification, x: F64, y: F64) -> F64:
    """(..., 2): where pixels ``x``, ``y`` (...) of the rectified image look, on the plane Z = 1 of C."""
    return np.stack([(x - rect.cx) / rect.f, (y - rect.cy) / rect.f], axis=-1)


def motion_of_camera(truth: Truth, rect: Rectification, t_ns: I64) -> tuple[F64, F64]:
    """True velocity (m/s) and angular velocity (rad/s) of C in frame C, (n, 3) each, at times within the truth's."""
    v_B, w_B = (interpolated(truth.t_ns, values, t_ns) for values in (truth.v_B, truth.omega_B))
    return (v_B + np.cross(w_B, rect.p_BC_B)) @ rect.R_CB.T, w_B @ rect.R_CB.T


@njit(cache=True, nogil=True)
def _follow_each(
    inverse: F32, image: I64, pinhole: F64, R_LC: F64, p_LC: F64, rays: F64, jump: float, depth: F64
) -> None:
    """Fill ``depth`` (m, k) for rays (m, k, 2) of cameras R_LC (m, 3, 3), p_LC (m, 3) relative to ``image`` (m,)."""
    direction = np.empty(3)
    for m in range(depth.shape[0]):
        for k in range(depth.shape[1]):
            for axis in range(3):
                direction[axis] = (
                    R_LC[m, axis, 0] * rays[m, k, 0] + R_LC[m, axis, 1] * rays[m, k, 1] + R_LC[m, axis, 2]
                )
            depth[m, k] = _follow(inverse[image[m]], pinhole, p_LC[m], direction, jump)


_NEAREST_M = 0.2
_MOST_STEPS = 400


@njit(cache=True, nogil=True)
def _follow(inverse: F32, pinhole: F64, p: F64, d: F64, jump: float) -> float:
    """Z of the first point p + Z d on the surface of an image of inverse depths, NaN where there is none to be seen.

    Steps of at most a pixel of the image, evenly in 1/Z, from near to far; then bisection.
    """
    per_z = 1.0 / _NEAREST_M
    steps = _steps(pinhole, p, d, per_z)
    before, at = np.nan, per_z
    for step in range(steps + 1):
        now_at = per_z * (1.0 - step / steps) + 1e-6
        now = _behind(inverse, pinhole, p, d, now_at, 0.0)
        if before < 0.0 and now >= 0.0:
            low, high = at, now_at
            for _ in range(40):
                middle = 0.5 * (low + high)
                if _behind(inverse, pinhole, p, d, middle, 0.0) < 0.0:
                    low = middle
                else:
                    high = middle
            # NaN where the corners around the place are not of one surface.
            return 1.0 / low + 0.0 * _behind(inverse, pinhole, p, d, low, jump)
        if np.isnan(before) and now >= 0.0:
            return np.nan  # it comes into view behind something
        before, at = now, now_at
    return np.nan


@njit(cache=True, nogil=True)
def _steps(pinhole: F64, p: F64, d: F64, per_z: float) -> int:
    """As many as pixels between the images of the nearest point and the farthest."""
    near = p * per_z + d
    if near[2] < 0.1 or d[2] < 0.1:
        return _MOST_STEPS
    u = pinhole[0] * (near[0] / near[2] - d[0] / d[2])
    v = pinhole[1] * (near[1] / near[2] - d[1] / d[2])
    return min(max(int(np.hypot(u, v)) + 1, 16), _MOST_STEPS)


@njit(cache=True, nogil=True)
def _behind(inverse: F32, pinhole: F64, p: F64, d: F64, per_z: float, jump: float) -> float:
    """How far the point at 1/Z = ``per_z`` is behind the image's surface, 1/m; NaN outside the image.

    With ``jump`` > 0 also NaN where the four pixels around differ by more than that share.
    """
    x, y, z = p[0] * per_z + d[0], p[1] * per_z + d[1], p[2] * per_z + d[2]
    if z < 0.05:
        return np.nan
    u, v = pinhole[0] * x / z + pinhole[2], pinhole[1] * y / z + pinhole[3]
    i, j = int(np.floor(u)), int(np.floor(v))
    if i < 0 or j < 0 or i + 1 >= inverse.shape[1] or j + 1 >= inverse.shape[0]:
        return np.nan
    a, b, c, e = (
        float(inverse[j, i]), float(inverse[j, i + 1]), float(inverse[j + 1, i]), float(inverse[j + 1, i + 1])
    )  # fmt: skip
    if jump > 0.0 and max(a, b, c, e) - min(a, b, c, e) > jump * 0.25 * (a + b + c + e):
        return np.nan
    share_x, share_y = u - i, v - j
    surface = (1.0 - share_y) * (a + share_x * (b - a)) + share_y * (c + share_x * (e - c))
    behind: float = surface - per_z / z
    return behind
