"""A pinned texture of overlapping leaves, with the pyramid that filters it at a pixel's footprint.

Dead leaves (Lee, Mumford, Huang, IJCV 2001): ellipses and rectangles of power-law sizes cover one another:
sharp edges in all directions at all scales, as in pictures of real places.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit

from velod.sim.kernels import SAME_BITS
from velod.types import F32, F64, I64

SIZE = 2048
"""Side of the texture at its finest level, texels; a power of two."""

TEXEL_M = 0.004
"""Side of a texel of the finest level on every surface, m. The texture repeats every SIZE * TEXEL_M = 8.2 m."""

COARSEST = 8
"""The last level of the pyramid: texels of 1 m."""


@dataclass(frozen=True, slots=True)
class Texture:
    """Levels of halved resolution in one array: level k has (SIZE >> k)^2 texels from ``offset[k]`` on."""

    texels: F32  # linear intensity, 0..1
    flat: F32  # likewise: the intensity where it is one in all 5 x 5 texels around, otherwise -1; level 0 is unused
    offset: I64  # (levels,)


@dataclass(frozen=True, slots=True)
class TextureRecipe:
    """What the leaves look like."""

    leaves: int = 1800
    smallest_m: float = 0.1  # radius
    largest_m: float = 0.8
    darkest: float = 0.08  # intensities are log-uniform between this and 1
    seed: int = 1


@lru_cache(maxsize=1)
def make_texture(recipe: TextureRecipe) -> Texture:
    """Paint the leaves and build the pyramid. The last one is kept: its arrays are for reading only."""
    rng = np.random.default_rng(recipe.seed)
    n = recipe.leaves
    # Radii of density r^-3, as scale invariance asks.
    low, high = recipe.smallest_m**-2, recipe.largest_m**-2
    radius = (low - rng.random(n) * (low - high)) ** -0.5 / TEXEL_M
    leaf = np.stack(
        [
            rng.random(n) * SIZE,
            rng.random(n) * SIZE,
            radius,
            radius * rng.uniform(0.4, 1.0, n),
            rng.uniform(0.0, np.pi, n),
            (rng.random(n) < 0.5).astype(np.float64),
            np.exp(rng.random(n) * np.log(recipe.darkest)),
        ],
        axis=1,
    )
    finest = np.full((SIZE, SIZE), 0.2, np.float32)
    _paint(leaf, finest)
    return _pyramid(_binomial(finest))


@njit(cache=True, nogil=True)
def _paint(leaf: F64, image: F32) -> None:
    """Rows of ``leaf``: x, y, half axes (texels), angle, 1 = ellipse or 0 = rectangle, intensity; the last covers."""
    size = image.shape[0]
    for k in range(leaf.shape[0]):
        x0, y0, a, b, angle, ellipse, value = leaf[k]
        c, s = np.cos(angle), np.sin(angle)
        reach = int(np.hypot(a, b)) + 1
        for j in range(int(y0) - reach, int(y0) + reach + 1):
            for i in range(int(x0) - reach, int(x0) + reach + 1):
                p = (c * (i - x0) + s * (j - y0)) / a
                q = (-s * (i - x0) + c * (j - y0)) / b
                inside = p * p + q * q < 1.0 if ellipse > 0.5 else abs(p) < 1.0 and abs(q) < 1.0
                if inside:
                    image[j % size, i % size] = value


def _binomial(image: F32) -> F32:
    """Band-limit with [1 2 1]/4 both ways; the texture wraps around."""
    for axis in (0, 1):
        image = (np.roll(image, 1, axis) + 2.0 * image + np.roll(image, -1, axis)) / 4.0
    return image.astype(np.float32)


def _pyramid(level: F32) -> Texture:
    levels, darkest, brightest = [level], level, level
    flat = [np.full_like(level, -1.0)]  # the finest is never asked for
    for _ in range(COARSEST):
        level, darkest, brightest = _halved(level, np.mean), _halved(darkest, np.min), _halved(brightest, np.max)
        levels.append(level)
        flat.append(_flat(darkest, brightest))
    offset = np.cumsum([0] + [part.size for part in levels[:-1]], dtype=np.int64)
    texels, flats = (np.concatenate([part.ravel() for part in parts]) for parts in (levels, flat))
    return Texture(texels, flats, offset)


def _halved(level: F32, value_of: Callable[..., F32]) -> F32:
    half = len(level) // 2
    return value_of(level.reshape(half, 2, half, 2), axis=(1, 3)).astype(np.float32)


def _flat(darkest: F32, brightest: F32) -> F32:
    """The one intensity of all that the 5 x 5 texels around cover, -1 where there are several."""
    for axis in (0, 1):
        darkest = np.minimum.reduce([np.roll(darkest, n, axis) for n in range(-2, 3)])
        brightest = np.maximum.reduce([np.roll(brightest, n, axis) for n in range(-2, 3)])
    return np.where(darkest == brightest, brightest, np.float32(-1.0))


@njit(cache=True, nogil=True, fastmath=SAME_BITS, error_model="numpy")
def sample(
    texels: F32,
    start: np.uint32,
    size: np.uint32,
    per_texel: np.float32,
    u: np.float32,
    v: np.float32,
    share: np.float32,
) -> np.float32:
    """Intensity at (u, v), in texels of the finest level, ``share`` of the way from a level to the next coarser one.

    ``start``: where the level begins in ``texels``; ``size``: its side; ``per_texel``: size / SIZE.
    """
    half, coarser = np.float32(0.5), size >> np.uint32(1)
    fine: np.float32 = _bilinear(texels, start, size, u * per_texel - half, v * per_texel - half)
    x, y = u * per_texel * half - half, v * per_texel * half - half
    coarse: np.float32 = _bilinear(texels, start + size * size, coarser, x, y)
    blend: np.float32 = fine + share * (coarse - fine)
    return blend


@njit(cache=True, nogil=True, fastmath=SAME_BITS, error_model="numpy")
def _bilinear(texels: F32, start: np.uint32, size: np.uint32, x: np.float32, y: np.float32) -> np.float32:
    """Between the four texels of a level around (x, y); the centre of texel i lies at i."""
    x0, y0 = np.floor(x), np.floor(y)
    p, q = x - x0, y - y0
    # Unsigned, so that numba does not ask for indices from the end; & wraps around.
    one, mask = np.uint32(1), size - np.uint32(1)
    i, j = np.uint32(np.int32(x0)) & mask, np.uint32(np.int32(y0)) & mask
    i1, row, row1 = (i + one) & mask, start + j * size, start + ((j + one) & mask) * size
    top = texels[row + i] + p * (texels[row + i1] - texels[row + i])
    bottom = texels[row1 + i] + p * (texels[row1 + i1] - texels[row1 + i])
    blend: np.float32 = top + q * (bottom - top)
    return blend
