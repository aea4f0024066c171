"""Where rays end: the depth, and the surface of the scene, that each pixel sees.

Only the wanted areas of the image are cast: ``[j0, j1, i0, i1]``, end exclusive, in each row of ``areas`` (m, 4).
A pixel's ray is p + Z d with d = R_WC (x', y', 1), so that the distance along it is the depth Z; (x', y') is the
pixel's place on the plane Z = 1, with the lens's distortion undone.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from velod.geometry.calibration import Camera
from velod.geometry.camera import normalised, undistort
from velod.sim.kernels import SAME_BITS
from velod.types import F32, F64, I64

I32 = NDArray[np.int32]


def rays_of(camera: Camera) -> F32:
    """(2, h, w): where each pixel looks, on the plane Z = 1."""
    j, i = np.mgrid[: camera.height, : camera.width]
    px = np.stack([i.ravel(), j.ravel()], axis=1).astype(np.float64)
    rays = undistort(normalised(px, camera), camera)
    return np.ascontiguousarray(rays.T.reshape(2, camera.height, camera.width).astype(np.float32))


@njit(cache=True, nogil=True)
def cast_shell_and_boxes(
    shell: F64,
    boxes: F64,
    R_WC: F64,
    p_WC: F64,
    rays: F32,
    areas: I64,
    aimed: F32,
    margin: float,
    depth: F32,
    surface: I32,
) -> None:
    """Which surface of a scene each ray of ``areas`` hits: ``depth`` (m, along the camera's z), ``surface``, (h, w).

    ``rays`` (2, h, w): x' and y' of every pixel. ``aimed`` (boxes, 19): to work in. ``margin``: a pixel, on Z = 1;
    boxes whose image lies further from an area are left out.
    """
    if shell.shape[0] == 3:
        _cast_corridor(shell, R_WC, p_WC, rays, areas, depth, surface)
    else:
        _cast_room(shell, R_WC, p_WC, rays, areas, depth, surface)
        _aim(boxes, R_WC, p_WC, aimed)
        _cast_boxes(aimed, margin, rays, areas, depth, surface)


@njit(cache=True, nogil=True)
def _cast_corridor(shell: F64, R_WC: F64, p: F64, rays: F32, areas: I64, depth: F32, surface: I32) -> None:
    """Nearest of inner cylinder (0), outer cylinder (1), floor (2) and ceiling (3)."""
    inner, outer, height = shell
    rr = p[0] * p[0] + p[1] * p[1]
    c_in, c_out = rr - inner * inner, rr - outer * outer
    for m in range(areas.shape[0]):
        for j in range(areas[m, 0], areas[m, 1]):
            for i in range(areas[m, 2], areas[m, 3]):
                xn, yn = np.float64(rays[0, j, i]), np.float64(rays[1, j, i])
                dx = R_WC[0, 0] * xn + R_WC[0, 1] * yn + R_WC[0, 2]
                dy = R_WC[1, 0] * xn + R_WC[1, 1] * yn + R_WC[1, 2]
                dz = R_WC[2, 0] * xn + R_WC[2, 1] * yn + R_WC[2, 2]
                a = dx * dx + dy * dy
                b = p[0] * dx + p[1] * dy
                disc = b * b - a * c_in
                if b < 0.0 and disc > 0.0:
                    z = (-b - np.sqrt(disc)) / a
                    s = 0
                else:
                    z = (-b + np.sqrt(b * b - a * c_out)) / a
                    s = 1
                if p[2] + z * dz < 0.0:
                    z = -p[2] / dz
                    s = 2
                elif p[2] + z * dz > height:
                    z = (height - p[2]) / dz
                    s = 3
                depth[j, i] = z
                surface[j, i] = s


# The loops over a row take single numbers and whole slices, choose without branches, and stay in single precision:
# so LLVM vectorises them, at 1e-6 of the depth.
@njit(cache=True, nogil=True)
def _cast_room(shell: F64, R_WC: F64, p: F64, rays: F32, areas: I64, depth: F32, surface: I32) -> None:
    """The wall, floor or ceiling that each ray leaves the room through (0..5)."""
    view = np.empty(15, np.float32)
    for k in range(3):
        view[3 * k], view[3 * k + 1], view[3 * k + 2] = R_WC[k, 0], R_WC[k, 1], R_WC[k, 2]
        view[9 + k], view[12 + k] = shell[k] - p[k], shell[3 + k] - p[k]
    for m in range(areas.shape[0]):
        i0, i1 = areas[m, 2], areas[m, 3]
        for j in range(areas[m, 0], areas[m, 1]):
            _leave_room(view, rays[0, j, i0:i1], rays[1, j, i0:i1], depth[j, i0:i1], surface[j, i0:i1])


@njit(cache=True, nogil=True, fastmath=SAME_BITS, error_model="numpy")
def _leave_room(view: F32, xs: F32, ys: F32, depth: F32, surface: I32) -> None:
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = (
        view[0], view[1], view[2], view[3], view[4], view[5], view[6], view[7], view[8],
    )  # fmt: skip
    x_low, y_low, z_low, x_high, y_high, z_high = view[9], view[10], view[11], view[12], view[13], view[14]
    zero = np.float32(0.0)
    for i in range(xs.shape[0]):
        x, y = xs[i], ys[i]
        dx, dy, dz = r00 * x + r01 * y + r02, r10 * x + r11 * y + r12, r20 * x + r21 * y + r22
        ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
        to_x = (x_high if ix > zero else x_low) * ix
        to_y = (y_high if iy > zero else y_low) * iy
        to_z = (z_high if iz > zero else z_low) * iz
        face_x = np.int32(1) if dx > zero else np.int32(0)
        face_y = np.int32(3) if dy > zero else np.int32(2)
        face_z = np.int32(5) if dz > zero else np.int32(4)
        nearest = to_x if to_x < to_y else to_y
        face = face_x if to_x < to_y else face_y
        depth[i] = nearest if nearest < to_z else to_z
        surface[i] = face if nearest < to_z else face_z


@njit(cache=True, nogil=True, fastmath=SAME_BITS, error_model="numpy")
def _inverse(d: np.float32) -> np.float32:
    """1 / d, large but finite for zero."""
    tiny = np.float32(1e-12)
    return np.float32(1.0) / (tiny if abs(d) < tiny else d)


_NEAR_M = 0.05


@njit(cache=True, nogil=True)
def _aim(boxes: F64, R_WC: F64, p: F64, aimed: F32) -> None:
    """For each box: R_WC and camera in the box's own axes (9 + 3), half sizes (3), bounds of its image (4)."""
    corner = np.empty((8, 3))
    for k in range(boxes.shape[0]):
        c, s = np.cos(boxes[k, 6]), np.sin(boxes[k, 6])
        x, y, z = p[0] - boxes[k, 0], p[1] - boxes[k, 1], p[2] - boxes[k, 2]
        for axis in range(3):
            aimed[k, axis] = c * R_WC[0, axis] + s * R_WC[1, axis]
            aimed[k, 3 + axis] = -s * R_WC[0, axis] + c * R_WC[1, axis]
            aimed[k, 6 + axis] = R_WC[2, axis]
            aimed[k, 12 + axis] = boxes[k, 3 + axis]
        aimed[k, 9], aimed[k, 10], aimed[k, 11] = c * x + s * y, -s * x + c * y, z
        for n in range(8):
            bx = boxes[k, 3] if n & 1 else -boxes[k, 3]
            by = boxes[k, 4] if n & 2 else -boxes[k, 4]
            wx, wy, wz = c * bx - s * by - x, s * bx + c * by - y, (boxes[k, 5] if n & 4 else -boxes[k, 5]) - z
            for axis in range(3):
                corner[n, axis] = R_WC[0, axis] * wx + R_WC[1, axis] * wy + R_WC[2, axis] * wz
        aimed[k, 15], aimed[k, 16], aimed[k, 17], aimed[k, 18] = _image_bounds(corner)


@njit(cache=True, nogil=True)
def _image_bounds(corner: F64) -> tuple[float, float, float, float]:
    """x0, x1, y0, y1 on Z = 1 outside which a box with these corners (8, 3), in camera axes, is not seen."""
    x0, x1, y0, y1 = np.inf, -np.inf, np.inf, -np.inf
    for a in range(8):
        # Each corner itself, and where the three edges to higher-numbered corners come out from behind the camera.
        for bit in (0, 1, 2, 4):
            b = a | bit
            if bit > 0 and (b == a or (corner[a, 2] < _NEAR_M) == (corner[b, 2] < _NEAR_M)):
                continue
            share = 0.0 if bit == 0 else (_NEAR_M - corner[a, 2]) / (corner[b, 2] - corner[a, 2])
            z = corner[a, 2] if bit == 0 else _NEAR_M
            if z < _NEAR_M:
                continue
            x = (corner[a, 0] + share * (corner[b, 0] - corner[a, 0])) / z
            y = (corner[a, 1] + share * (corner[b, 1] - corner[a, 1])) / z
            x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
    return x0, x1, y0, y1


@njit(cache=True, nogil=True)
def _cast_boxes(aimed: F32, margin: float, rays: F32, areas: I64, depth: F32, surface: I32) -> None:
    """Replace what a box hides, in the areas that its image touches. ``margin``: a pixel, on Z = 1."""
    for m in range(areas.shape[0]):
        j0, j1, i0, i1 = areas[m, 0], areas[m, 1], areas[m, 2], areas[m, 3]
        # A distorted area's sides are straight to far less than a pixel.
        x0 = min(rays[0, j0, i0], rays[0, j1 - 1, i0]) - margin
        x1 = max(rays[0, j0, i1 - 1], rays[0, j1 - 1, i1 - 1]) + margin
        y0 = min(rays[1, j0, i0], rays[1, j0, i1 - 1]) - margin
        y1 = max(rays[1, j1 - 1, i0], rays[1, j1 - 1, i1 - 1]) + margin
        for k in range(aimed.shape[0]):
            if aimed[k, 15] > x1 or aimed[k, 16] < x0 or aimed[k, 17] > y1 or aimed[k, 18] < y0:
                continue
            for j in range(j0, j1):
                _hit_box(
                    aimed[k], np.int32(6 + 6 * k), rays[0, j, i0:i1], rays[1, j, i0:i1], depth[j, i0:i1],
                    surface[j, i0:i1],
                )  # fmt: skip


@njit(cache=True, nogil=True, fastmath=SAME_BITS, error_model="numpy")
def _hit_box(box: F32, first: np.int32, xs: F32, ys: F32, depth: F32, surface: I32) -> None:
    """Where each ray enters |x| < hx, |y| < hy, |z| < hz of the box's own axes, and through which face."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = (
        box[0], box[1], box[2], box[3], box[4], box[5], box[6], box[7], box[8],
    )  # fmt: skip
    ox, oy, oz, hx, hy, hz = box[9], box[10], box[11], box[12], box[13], box[14]
    zero = np.float32(0.0)
    for i in range(xs.shape[0]):
        x, y = xs[i], ys[i]
        dx, dy, dz = r00 * x + r01 * y + r02, r10 * x + r11 * y + r12, r20 * x + r21 * y + r22
        ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
        reach_x, reach_y, reach_z = hx * abs(ix), hy * abs(iy), hz * abs(iz)
        enter_x, enter_y, enter_z = -ox * ix - reach_x, -oy * iy - reach_y, -oz * iz - reach_z
        leave_x, leave_y, leave_z = -ox * ix + reach_x, -oy * iy + reach_y, -oz * iz + reach_z
        enter = enter_x if enter_x > enter_y else enter_y
        face = np.int32(0 if dx > zero else 1) if enter_x > enter_y else np.int32(2 if dy > zero else 3)
        face = face if enter > enter_z else np.int32(4 if dz > zero else 5)
        enter = enter if enter > enter_z else enter_z
        leave = leave_x if leave_x < leave_y else leave_y
        leave = leave if leave < leave_z else leave_z
        z = depth[i]
        hit = (enter <= leave) & (enter > zero) & (enter < z)
        depth[i] = enter if hit else z
        surface[i] = first + face if hit else surface[i]
