"""Scenes: surfaces with a place on the texture, in one table that the renderer reads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from velod.sim.texture import SIZE, TEXEL_M
from velod.types import F64


@dataclass(frozen=True, slots=True)
class Scene:
    """What can be seen: a shell around the camera, and boxes inside it.

    ``shell``: ``[inner radius, outer radius, height]`` of a circular corridor about W's z axis, or
    ``[x0, y0, z0, x1, y1, z1]`` of a room. ``boxes``: (k, 7) centre, half sizes, yaw.
    ``surfaces``: (s, 12) unit normal, unit tangents e_u and e_v in W, offset on the texture (m), radius of a cylinder
    (0 = plane). A point P of a plane has the texture coordinates e_u.P + u0, e_v.P + v0; of a cylinder, arc length
    and height. Order: corridor: inner, outer, floor, ceiling; room: -x, +x, -y, +y, floor, ceiling, then the same six
    of each box.
    """

    shell: F64
    boxes: F64
    surfaces: F64


def corridor(inner_m: float, outer_m: float, height_m: float, seed: int) -> Scene:
    """A circular corridor between two cylinders about W's z axis, floor at z = 0."""
    rng = np.random.default_rng(seed)
    x, y, z = np.eye(3)
    rows = [
        _surface(x, y, z, rng, inner_m),
        _surface(x, y, z, rng, outer_m),
        _surface(z, x, y, rng),
        _surface(-z, x, y, rng),
    ]
    return Scene(np.array([inner_m, outer_m, height_m]), np.empty((0, 7)), np.array(rows))


def room(size_m: tuple[float, float, float], boxes: F64, seed: int) -> Scene:
    """A room centred on W's origin, floor at z = 0, with ``boxes`` (k, 7) inside."""
    rng = np.random.default_rng(seed)
    half_x, half_y, height = size_m[0] / 2, size_m[1] / 2, size_m[2]
    rows = _six_faces(0.0, rng)
    for box in boxes:
        rows += _six_faces(box[6], rng)
    return Scene(np.array([-half_x, -half_y, 0.0, half_x, half_y, height]), boxes, np.array(rows))


def scatter_boxes(
    size_m: tuple[float, float, float], keep_clear: F64, clearance_m: float, count: int, seed: int
) -> F64:
    """Boxes at random places of a room, none within ``clearance_m`` of the points ``keep_clear`` (n, 3)."""
    rng = np.random.default_rng(seed)
    found: list[F64] = []
    for _ in range(100 * count):
        half = np.array([rng.uniform(0.15, 0.6), rng.uniform(0.15, 0.6), rng.uniform(0.2, size_m[2] / 2)])
        x, y = (rng.uniform(-s / 2 + 0.3, s / 2 - 0.3) for s in size_m[:2])
        z = half[2] if rng.random() < 0.6 else rng.uniform(half[2], size_m[2])
        reach = float(np.linalg.norm(half)) + clearance_m
        if np.linalg.norm(keep_clear - (x, y, z), axis=1).min() > reach:
            found.append(np.array([x, y, z, *half, rng.uniform(0.0, np.pi)]))
        if len(found) == count:
            break
    return np.array(found).reshape(-1, 7)


def _six_faces(yaw: float, rng: np.random.Generator) -> list[F64]:
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = np.array([c, s, 0.0]), np.array([-s, c, 0.0]), np.array([0.0, 0.0, 1.0])
    faces = ((-x, y, z), (x, y, z), (-y, x, z), (y, x, z), (-z, x, y), (z, x, y))
    return [_surface(n, e_u, e_v, rng) for n, e_u, e_v in faces]


def _surface(normal: F64, e_u: F64, e_v: F64, rng: np.random.Generator, radius: float = 0.0) -> F64:
    return np.array([*normal, *e_u, *e_v, *rng.uniform(0.0, SIZE * TEXEL_M, 2), radius])
