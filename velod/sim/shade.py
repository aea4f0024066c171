"""Intensity of what rays hit: the scene's texture there, filtered over each pixel's footprint on the surface."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from velod.sim.kernels import SAME_BITS
from velod.sim.texture import COARSEST, SIZE, TEXEL_M, sample
from velod.types import F32, F64, I64

I32 = NDArray[np.int32]
U32 = NDArray[np.uint32]
MAX_ROW = 2048
"""Rays beside each other that can be cast."""
# Parts of the work array: place on the texture (texels), half the way between its two samples, footprint squared.
# They lie a constant apart in one array: so LLVM sees that they do not overlap, and vectorises.
_U, _V, _HALF_U, _HALF_V, _FOOTPRINT2 = (np.uint64(part * MAX_ROW) for part in range(5))


# Single precision throughout, and in runs of pixels that see one surface, so that LLVM vectorises what it can: half
# the time of the obvious loop, at 1e-4 px on the image.
@njit(cache=True, nogil=True)
def shade(
    surfaces: F32,
    texels: F32,
    flat: F32,
    starts: U32,
    rays: F32,
    focal: F64,
    R_WC: F64,
    p: F64,
    areas: I64,
    depth: F32,
    surface: I32,
    intensity: F32,
    work: F32,
) -> None:
    """Intensity of every pixel: the texture at the point hit, filtered over the pixel's footprint there."""
    # The camera's axes and place, and 1 / f.
    view = np.empty(14, np.float32)
    for k in range(3):
        view[k], view[3 + k], view[6 + k], view[9 + k] = R_WC[k, 0], R_WC[k, 1], R_WC[k, 2], p[k]
    view[12], view[13] = 1.0 / focal[0], 1.0 / focal[1]
    for m in range(areas.shape[0]):
        first, end = areas[m, 2], areas[m, 3]
        for j in range(areas[m, 0], areas[m, 1]):
            start = first
            while start < end:
                k, stop = surface[j, start], start + 1
                while stop < end and surface[j, stop] == k:
                    stop += 1
                xs, ys, zs = rays[0, j, start:stop], rays[1, j, start:stop], depth[j, start:stop]
                if surfaces[k, 11] > 0.0:
                    _locate_on_cylinder(surfaces[k], view, xs, ys, zs, work[start - first :])
                else:
                    _locate_on_plane(surfaces[k], view, xs, ys, zs, work[start - first :])
                start = stop
            _sample_row(texels, flat, starts, work, intensity[j, first:end])


@njit(cache=True, nogil=True, fastmath=SAME_BITS, error_model="numpy")
def _locate_on_plane(surface: F32, view: F32, xs: F32, ys: F32, depth: F32, work: F32) -> None:
    """Fill ``work``, from the first element of each part on, for a run of pixels that see one plane."""
    r00, r10, r20 = view[0], view[1], view[2]
    r01, r11, r21 = view[3], view[4], view[5]
    r02, r12, r22 = view[6], view[7], view[8]
    p0, p1, p2 = view[9], view[10], view[11]
    per_fx, per_fy = view[12], view[13]
    nx, ny, nz = surface[0], surface[1], surface[2]
    ux, uy, uz = surface[3], surface[4], surface[5]
    vx, vy, vz = surface[6], surface[7], surface[8]
    u0, v0 = surface[9], surface[10]
    per_m = np.float32(1.0 / TEXEL_M)
    for i in range(depth.shape[0]):
        at = np.uint64(i)  # unsigned, so that numba does not ask for indices from the end
        xn, yn = xs[i], ys[i]
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
        work[at + _U] = (ux * px + uy * py + uz * pz + u0) * per_m
        work[at + _V] = (vx * px + vy * py + vz * pz + v0) * per_m
        work[at + _HALF_U], work[at + _HALF_V], work[at + _FOOTPRINT2] = _taps(u_x, v_x, u_y, v_y)


@njit(cache=True, nogil=True, fastmath=SAME_BITS, error_model="numpy")
def _locate_on_cylinder(surface: F32, view: F32, xs: F32, ys: F32, depth: F32, work: F32) -> None:
    """As ``_locate_on_plane``, for an upright cylinder about W's z axis."""
    r00, r10, r20 = view[0], view[1], view[2]
    r01, r11, r21 = view[3], view[4], view[5]
    r02, r12, r22 = view[6], view[7], view[8]
    p0, p1, p2 = view[9], view[10], view[11]
    per_fx, per_fy = view[12], view[13]
    u0, v0, radius = surface[9], surface[10], surface[11]
    per_m = np.float32(1.0 / TEXEL_M)
    for i in range(depth.shape[0]):
        at = np.uint64(i)  # unsigned, so that numba does not ask for indices from the end
        xn, yn = xs[i], ys[i]
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
        work[at + _U], work[at + _V] = (radius * _atan2(py, px) + u0) * per_m, (pz + v0) * per_m
        work[at + _HALF_U], work[at + _HALF_V], work[at + _FOOTPRINT2] = _taps(u_x, v_x, u_y, v_y)


@njit(cache=True, nogil=True, fastmath=SAME_BITS, error_model="numpy")
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


@njit(cache=True, nogil=True, fastmath=SAME_BITS, error_model="numpy")
def _sample_row(texels: F32, flat: F32, starts: U32, work: F32, intensity: F32) -> None:
    """The mean of each pixel's two samples, between the two levels of the pyramid around its footprint."""
    one, half = np.float32(1.0), np.float32(0.5)
    for i in range(intensity.shape[0]):
        at = np.uint64(i)
        footprint2 = work[at + _FOOTPRINT2]
        # The level whose texels are the next smaller to the footprint: half the exponent of its square.
        exponent = (np.float32(footprint2).view(np.int32) >> 23) - 127
        level = exponent >> 1 if exponent > 0 else 0
        level = level if level < COARSEST else COARSEST - 1
        start, size, scale = starts[level], np.uint32(SIZE) >> np.uint32(level), np.float32(1 << level)
        u, v = work[at + _U], work[at + _V]
        # Both samples and both levels stay within the 5 x 5 texels of the coarser level around (u, v).
        per_coarse, coarser = half / scale, size >> np.uint32(1)
        column = np.uint32(np.int32(np.floor(u * per_coarse))) & (coarser - np.uint32(1))
        row = np.uint32(np.int32(np.floor(v * per_coarse))) & (coarser - np.uint32(1))
        only = flat[start + size * size + row * coarser + column]
        if only > np.float32(0.0):
            intensity[i] = only
            continue
        # log2 of the footprint between 1 and 2 texels, to 1 %; beyond the coarsest level there is no more.
        e = min(np.sqrt(max(footprint2 / (scale * scale), one)) - one, one)
        share = e * (np.float32(1.34) - np.float32(0.34) * e)
        half_u, half_v = work[at + _HALF_U], work[at + _HALF_V]
        first = sample(texels, start, size, one / scale, u - half_u, v - half_v, share)
        second = sample(texels, start, size, one / scale, u + half_u, v + half_v, share)
        intensity[i] = half * (first + second)


@njit(cache=True, nogil=True, fastmath=SAME_BITS, error_model="numpy")
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
