"""Ray caster: depth and intensity of what an undistorted pinhole camera sees of a scene.

Only the wanted areas of the image are rendered: ``[j0, j1, i0, i1]``, end exclusive, in each row of ``areas`` (m, 4).
A pixel's ray is p + Z d with d = R_WC (x', y', 1), so that the distance along it is the depth Z.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.geometry.calibration import Camera
from velod.sim.scene import Scene
from velod.sim.texture import COARSEST, SIZE, TEXEL_M, Texture, sample
from velod.types import F32, F64, I64


class Renderer:
    """One camera's view of a scene. ``depth`` (m, along the camera's z) and ``intensity`` (0..1) are (h, w)."""

    def __init__(self, scene: Scene, texture: Texture, camera: Camera) -> None:
        shape = (camera.height, camera.width)
        self.depth: F32 = np.zeros(shape, np.float32)
        self.intensity: F32 = np.zeros(shape, np.float32)
        self._surface: I64 = np.zeros(shape, np.int64)
        self._pinhole = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        self._scene, self._texture = scene, texture
        self._surfaces = scene.surfaces.astype(np.float32)
        self._work: F32 = np.empty((5, camera.width), np.float32)

    def render(self, R_WC: F64, p_WC: F64, areas: I64) -> None:
        """Bring ``areas`` up to date for a camera at ``p_WC`` (m, in W) with axes ``R_WC``."""
        scene, pose = self._scene, (self._pinhole, np.ascontiguousarray(R_WC), np.ascontiguousarray(p_WC))
        if len(scene.shell) == 3:
            _cast_corridor(scene.shell, *pose, areas, self.depth, self._surface)
        else:
            _cast_room(scene.shell, *pose, areas, self.depth, self._surface)
            _cast_boxes(scene.boxes, *pose, areas, self.depth, self._surface)
        texture = self._texture
        _shade(
            self._surfaces,
            texture.texels,
            *pose,
            areas,
            self.depth,
            self._surface,
            self.intensity,
            self._work,
        )


@njit(cache=True, nogil=True)
def _cast_corridor(shell: F64, pinhole: F64, R_WC: F64, p: F64, areas: I64, depth: F32, surface: I64) -> None:
    """Nearest of inner cylinder (0), outer cylinder (1), floor (2) and ceiling (3)."""
    fx, fy, cx, cy = pinhole
    inner, outer, height = shell
    rr = p[0] * p[0] + p[1] * p[1]
    c_in, c_out = rr - inner * inner, rr - outer * outer
    for m in range(areas.shape[0]):
        for j in range(areas[m, 0], areas[m, 1]):
            yn = (j - cy) / fy
            for i in range(areas[m, 2], areas[m, 3]):
                xn = (i - cx) / fx
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


@njit(cache=True, nogil=True)
def _cast_room(shell: F64, pinhole: F64, R_WC: F64, p: F64, areas: I64, depth: F32, surface: I64) -> None:
    """The wall, floor or ceiling that each ray leaves the room through (0..5)."""
    fx, fy, cx, cy = pinhole
    for m in range(areas.shape[0]):
        for j in range(areas[m, 0], areas[m, 1]):
            yn = (j - cy) / fy
            for i in range(areas[m, 2], areas[m, 3]):
                xn = (i - cx) / fx
                z, s = np.inf, 0
                for k in range(3):
                    d = R_WC[k, 0] * xn + R_WC[k, 1] * yn + R_WC[k, 2]
                    if d != 0.0:
                        at = ((shell[3 + k] if d > 0.0 else shell[k]) - p[k]) / d
                        if at < z:
                            z, s = at, 2 * k + (1 if d > 0.0 else 0)
                depth[j, i] = z
                surface[j, i] = s


@njit(cache=True, nogil=True)
def _cast_boxes(boxes: F64, pinhole: F64, R_WC: F64, p: F64, areas: I64, depth: F32, surface: I64) -> None:
    """Replace what a box hides. Only the pixels around each box's image are tried."""
    fx, fy, cx, cy = pinhole
    height, width = depth.shape
    for k in range(boxes.shape[0]):
        box_i0, box_i1, box_j0, box_j1 = _box_bounds(boxes[k], pinhole, R_WC, p, width, height)
        c, s = np.cos(boxes[k, 6]), np.sin(boxes[k, 6])
        # Camera in the box's own axes, in which the slabs are axis-aligned.
        ox = c * (p[0] - boxes[k, 0]) + s * (p[1] - boxes[k, 1])
        oy = -s * (p[0] - boxes[k, 0]) + c * (p[1] - boxes[k, 1])
        oz = p[2] - boxes[k, 2]
        hx, hy, hz = boxes[k, 3], boxes[k, 4], boxes[k, 5]
        for m in range(areas.shape[0]):
            i0, i1 = max(areas[m, 2], box_i0), min(areas[m, 3], box_i1)
            for j in range(max(areas[m, 0], box_j0), min(areas[m, 1], box_j1)):
                yn = (j - cy) / fy
                for i in range(i0, i1):
                    xn = (i - cx) / fx
                    wx = R_WC[0, 0] * xn + R_WC[0, 1] * yn + R_WC[0, 2]
                    wy = R_WC[1, 0] * xn + R_WC[1, 1] * yn + R_WC[1, 2]
                    dz = R_WC[2, 0] * xn + R_WC[2, 1] * yn + R_WC[2, 2]
                    z, face = _slabs(ox, oy, oz, c * wx + s * wy, -s * wx + c * wy, dz, hx, hy, hz)
                    if 0.0 < z < depth[j, i]:
                        depth[j, i] = z
                        surface[j, i] = 6 + 6 * k + face


@njit(cache=True, nogil=True)
def _slabs(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, hx: float, hy: float, hz: float
) -> tuple[float, int]:
    """Where the ray enters |x| < hx, |y| < hy, |z| < hz, and through which face; (-1, 0) if it does not."""
    tiny = 1e-12
    ix = 1.0 / (dx if abs(dx) > tiny else tiny)
    iy = 1.0 / (dy if abs(dy) > tiny else tiny)
    iz = 1.0 / (dz if abs(dz) > tiny else tiny)
    reach_x, reach_y, reach_z = hx * abs(ix), hy * abs(iy), hz * abs(iz)
    enter_x, enter_y, enter_z = -ox * ix - reach_x, -oy * iy - reach_y, -oz * iz - reach_z
    enter = max(enter_x, enter_y, enter_z)
    if enter > min(-ox * ix + reach_x, -oy * iy + reach_y, -oz * iz + reach_z):
        return -1.0, 0
    if enter == enter_x:
        return enter, 0 if dx > 0.0 else 1
    if enter == enter_y:
        return enter, 2 if dy > 0.0 else 3
    return enter, 4 if dz > 0.0 else 5


@njit(cache=True, nogil=True)
def _box_bounds(box: F64, pinhole: F64, R_WC: F64, p: F64, width: int, height: int) -> tuple[int, int, int, int]:
    """Columns i0..i1 and rows j0..j1 (exclusive) outside which the box is not seen."""
    fx, fy, cx, cy = pinhole
    c, s = np.cos(box[6]), np.sin(box[6])
    x_min, x_max, y_min, y_max, behind = np.inf, -np.inf, np.inf, -np.inf, 0
    for corner in range(8):
        bx = box[3] if corner & 1 else -box[3]
        by = box[4] if corner & 2 else -box[4]
        wx, wy = box[0] + c * bx - s * by - p[0], box[1] + s * bx + c * by - p[1]
        wz = box[2] + (box[5] if corner & 4 else -box[5]) - p[2]
        z = R_WC[0, 2] * wx + R_WC[1, 2] * wy + R_WC[2, 2] * wz
        if z < 0.05:
            behind += 1
            continue
        x = cx + fx * (R_WC[0, 0] * wx + R_WC[1, 0] * wy + R_WC[2, 0] * wz) / z
        y = cy + fy * (R_WC[0, 1] * wx + R_WC[1, 1] * wy + R_WC[2, 1] * wz) / z
        x_min, x_max, y_min, y_max = min(x_min, x), max(x_max, x), min(y_min, y), max(y_max, y)
    if behind == 8:
        return 0, 0, 0, 0
    if behind > 0:
        return 0, width, 0, height
    i0, i1 = int(min(max(x_min, 0.0), width)), int(min(max(x_max + 2.0, 0.0), width))
    j0, j1 = int(min(max(y_min, 0.0), height)), int(min(max(y_max + 2.0, 0.0), height))
    return i0, i1, j0, j1


# Rows of the work array: place on the texture (texels), half the way between its two samples, footprint squared.
_U, _V, _HALF_U, _HALF_V, _FOOTPRINT2 = range(5)


# Single precision throughout, and in runs of pixels that see one surface, so that LLVM vectorises what it can: half
# the time of the obvious loop, at 1e-4 px on the image.
@njit(cache=True, nogil=True)
def _shade(
    surfaces: F32,
    texels: F32,
    pinhole: F64,
    R_WC: F64,
    p: F64,
    areas: I64,
    depth: F32,
    surface: I64,
    intensity: F32,
    work: F32,
) -> None:
    """Intensity of every pixel: the texture at the point hit, filtered over the pixel's footprint there."""
    # The camera's axes and place, f, and what is left of the principal point: all that a row needs.
    view = np.empty(16, np.float32)
    for k in range(3):
        view[k], view[3 + k], view[6 + k], view[9 + k] = R_WC[k, 0], R_WC[k, 1], R_WC[k, 2], p[k]
    fx, fy, cx, cy = pinhole
    view[12], view[13] = 1.0 / fx, 1.0 / fy
    for m in range(areas.shape[0]):
        first, end = areas[m, 2], areas[m, 3]
        for j in range(areas[m, 0], areas[m, 1]):
            view[15] = (j - cy) / fy
            start = first
            while start < end:
                k, stop = surface[j, start], start + 1
                while stop < end and surface[j, stop] == k:
                    stop += 1
                view[14] = (start - cx) / fx
                if surfaces[k, 11] > 0.0:
                    _locate_on_cylinder(surfaces[k], view, depth[j, start:stop], start - first, work)
                else:
                    _locate_on_plane(surfaces[k], view, depth[j, start:stop], start - first, work)
                start = stop
            _sample_row(texels, work, intensity[j, first:end])


@njit(cache=True, nogil=True, fastmath=True)
def _locate_on_plane(surface: F32, view: F32, depth: F32, at: int, work: F32) -> None:
    """Fill columns ``at`` onwards of ``work`` for a run of pixels that see one plane."""
    r00, r10, r20 = view[0], view[1], view[2]
    r01, r11, r21 = view[3], view[4], view[5]
    r02, r12, r22 = view[6], view[7], view[8]
    p0, p1, p2 = view[9], view[10], view[11]
    per_fx, per_fy, x0, yn = view[12], view[13], view[14], view[15]
    nx, ny, nz = surface[0], surface[1], surface[2]
    ux, uy, uz = surface[3], surface[4], surface[5]
    vx, vy, vz = surface[6], surface[7], surface[8]
    u0, v0 = surface[9], surface[10]
    per_m = np.float32(1.0 / TEXEL_M)
    for i in range(depth.shape[0]):
        xn = x0 + np.float32(i) * per_fx
        dx, dy, dz = r00 * xn + r01 * yn + r02, r10 * xn + r11 * yn + r12, r20 * xn + r21 * yn + r22
        z = depth[i]
        px, py, pz = p0 + z * dx, p1 + z * dy, p2 + z * dz
        # One pixel along the camera's axis e moves the point hit by z/f (e - d (n.e)/(n.d)).
        nd = np.float32(1.0) / (nx * dx + ny * dy + nz * dz)
        ud, vd = (ux * dx + uy * dy + uz * dz) * nd, (vx * dx + vy * dy + vz * dz) * nd
        n_x, n_y = nx * r00 + ny * r10 + nz * r20, nx * r01 + ny * r11 + nz * r21
        gx, gy = z * per_m * per_fx, z * per_m * per_fy
        u_x, v_x = gx * (ux * r00 + uy * r10 + uz * r20 - ud * n_x), gx * (vx * r00 + vy * r10 + vz * r20 - vd * n_x)
        u_y, v_y = gy * (ux * r01 + uy * r11 + uz * r21 - ud * n_y), gy * (vx * r01 + vy * r11 + vz * r21 - vd * n_y)
        work[_U, at + i], work[_V, at + i] = (
            (ux * px + uy * py + uz * pz + u0) * per_m,
            (vx * px + vy * py + vz * pz + v0) * per_m,
        )
        work[_HALF_U, at + i], work[_HALF_V, at + i], work[_FOOTPRINT2, at + i] = _taps(u_x, v_x, u_y, v_y)


@njit(cache=True, nogil=True, fastmath=True)
def _locate_on_cylinder(surface: F32, view: F32, depth: F32, at: int, work: F32) -> None:
    """As ``_locate_on_plane``, for an upright cylinder about W's z axis."""
    r00, r10, r20 = view[0], view[1], view[2]
    r01, r11, r21 = view[3], view[4], view[5]
    r02, r12, r22 = view[6], view[7], view[8]
    p0, p1, p2 = view[9], view[10], view[11]
    per_fx, per_fy, x0, yn = view[12], view[13], view[14], view[15]
    u0, v0, radius = surface[9], surface[10], surface[11]
    per_m = np.float32(1.0 / TEXEL_M)
    for i in range(depth.shape[0]):
        xn = x0 + np.float32(i) * per_fx
        dx, dy, dz = r00 * xn + r01 * yn + r02, r10 * xn + r11 * yn + r12, r20 * xn + r21 * yn + r22
        z = depth[i]
        px, py, pz = p0 + z * dx, p1 + z * dy, p2 + z * dz
        r = np.float32(1.0) / np.sqrt(px * px + py * py)
        # n = (nx, ny, 0), e_u = (-ny, nx, 0), e_v = (0, 0, 1)
        nx, ny = px * r, py * r
        nd = np.float32(1.0) / (nx * dx + ny * dy)
        ud, vd = (nx * dy - ny * dx) * nd, dz * nd
        n_x, n_y = nx * r00 + ny * r10, nx * r01 + ny * r11
        gx, gy = z * per_m * per_fx, z * per_m * per_fy
        u_x, v_x = gx * (nx * r10 - ny * r00 - ud * n_x), gx * (r20 - vd * n_x)
        u_y, v_y = gy * (nx * r11 - ny * r01 - ud * n_y), gy * (r21 - vd * n_y)
        work[_U, at + i], work[_V, at + i] = (radius * _atan2(py, px) + u0) * per_m, (pz + v0) * per_m
        work[_HALF_U, at + i], work[_HALF_V, at + i], work[_FOOTPRINT2, at + i] = _taps(u_x, v_x, u_y, v_y)


@njit(cache=True, nogil=True, fastmath=True)
def _taps(
    u_x: np.float32, v_x: np.float32, u_y: np.float32, v_y: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """Two samples along the longer side of a footprint: half their distance, and the extent squared of each."""
    quarter = np.float32(0.25)
    x2, y2 = u_x * u_x + v_x * v_x, u_y * u_y + v_y * v_y
    long2 = max(x2, y2)
    half_u, half_v = quarter * (u_y if y2 > x2 else u_x), quarter * (v_y if y2 > x2 else v_x)
    # Area over length is the extent across, also where the two sides are far from orthogonal.
    area = u_x * v_y - u_y * v_x
    return half_u, half_v, max(quarter * long2, area * area / long2)


@njit(cache=True, nogil=True, fastmath=True)
def _sample_row(texels: F32, work: F32, intensity: F32) -> None:
    """The mean of each pixel's two samples, between the two levels of the pyramid around its footprint."""
    one, half, coarsest = np.float32(1.0), np.float32(0.5), np.uint32(2 * SIZE >> COARSEST)
    for i in range(intensity.shape[0]):
        footprint2 = work[_FOOTPRINT2, i]
        # The level whose texels are the next smaller to the footprint.
        start, size, scale = np.uint32(0), np.uint32(SIZE), one
        while footprint2 > np.float32(4.0) * scale * scale and size > coarsest:
            start += size * size
            size >>= np.uint32(1)
            scale *= np.float32(2.0)
        # log2 of the footprint between 1 and 2 texels, to 1 %.
        e = np.sqrt(max(footprint2 / (scale * scale), one)) - one
        share = min(e * (np.float32(1.34) - np.float32(0.34) * e), one)
        u, v, half_u, half_v = work[_U, i], work[_V, i], work[_HALF_U, i], work[_HALF_V, i]
        first = sample(texels, start, size, one / scale, u - half_u, v - half_v, share)
        second = sample(texels, start, size, one / scale, u + half_u, v + half_v, share)
        intensity[i] = half * (first + second)


@njit(cache=True, nogil=True, fastmath=True)
def _atan2(y: np.float32, x: np.float32) -> np.float32:
    """atan2 to 1e-6 rad (Abramowitz and Stegun 4.4.49), several times as fast as the library's."""
    f32 = np.float32
    ax, ay = abs(x), abs(y)
    q = min(ax, ay) / max(ax, ay)
    s = q * q
    a = f32(0.0218612288) - f32(0.0040540580) * s
    a = f32(0.0964200441) + s * (f32(-0.0559098861) + s * a)
    a = f32(0.1994653599) + s * (f32(-0.1390853351) + s * a)
    a = q * (f32(0.9999993329) + s * (f32(-0.3332985605) + s * a))
    a = f32(0.5 * np.pi) - a if ay > ax else a
    a = f32(np.pi) - a if x < f32(0.0) else a
    return -a if y < f32(0.0) else a
