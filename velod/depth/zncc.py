"""Sparse block matching of time surfaces along rectified rows by zero-normalised cross-correlation (ZNCC)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from velod.types import F32, F64, I64

# A block whose variance is below this is flat: nothing to match.
_FLAT = 1e-6

NONE = np.float32(-2.0)
"""A score that is none, below all that are."""
RIVAL_PX = 2
"""Scores this close to the best one belong to it."""

USUAL_HALF = 8
"""Of a block of 17 px."""

CHUNK = 56
"""Disparities that are correlated at once: a constant, and of 8, so that the compiler leaves no remainder loop."""


class Surface(NamedTuple):
    """A time surface (h, w) with the integral images (h + 1, w + 1) of itself and of its square."""

    values: F32
    flat: F32  # the same memory, and CHUNK more
    total: F64
    total_of_squares: F64

    @staticmethod
    def of(values: F32) -> Surface:
        """From a time surface (h, w), 0..1, which is copied."""
        flat = np.zeros(values.size + CHUNK, np.float32)
        same = flat[: values.size].reshape(values.shape)
        same[:] = values
        total, squares = cv2.integral2(same, sdepth=cv2.CV_64F, sqdepth=cv2.CV_64F)
        return Surface(same, flat, np.asarray(total, dtype=np.float64), np.asarray(squares, dtype=np.float64))


@dataclass(frozen=True, slots=True)
class Matches:
    """Best match of each point, NaN where its block or every candidate leaves the image, or is flat."""

    disparity: F32  # (n,) px, sub-pixel
    score: F32  # (n,) ZNCC of the best whole disparity, -1..1
    second: F32  # (n,) ZNCC of the best one more than 2 px away, -1: none
    scores: F32  # (n, >= max_disparity_px + 1) ZNCC of each whole disparity, NONE where its block leaves the image
    enclosed: NDArray[np.bool_]  # (n,) the best has a neighbour on both sides: a real peak


def match(
    reference: Surface, mirrored_other: Surface, x: I64, y: I64, block_px: int, max_disparity_px: int
) -> Matches:
    """Match blocks centred at (x, y) of ``reference`` with those at (x - d, y) of the other camera, d = 0..max.

    The other surface is mirrored left to right, so that disparity runs along memory. To match the other way, swap
    and mirror: the mirrored right surface is the reference, its x is w - 1 - x, and the left one is as it is.
    """
    n = x.shape[0]
    disparity, score, second = (np.empty(n, np.float32) for _ in range(3))
    room = -(-(max_disparity_px + 1) // CHUNK) * CHUNK
    out = Matches(disparity, score, second, np.empty((n, room), np.float32), np.empty(n, dtype=np.bool_))
    half = block_px // 2
    _match(
        reference,
        mirrored_other,
        x,
        y,
        half,
        max_disparity_px,
        np.empty(room, np.float32),
        np.empty(block_px, np.float32),
        out.disparity,
        out.score,
        out.second,
        out.scores,
        out.enclosed,
    )
    return out


@njit(cache=True, nogil=True)
def _block_sum(total: F64, x: int, y: int, half: int) -> float:
    """Sum over the block centred at (x, y) from an integral image."""
    return float(
        total[y + half + 1, x + half + 1]
        - total[y - half, x + half + 1]
        - total[y + half + 1, x - half]
        + total[y - half, x - half]
    )


@njit(cache=True, nogil=True, fastmath={"contract"})
def _correlate(
    reference: F32,
    mirrored: F32,
    x: int,
    y: int,
    xm: int,
    half: int,
    mean: float,
    n: int,
    row: F32,
    out: F32,
) -> None:
    """out[d] = sum over the block of (reference - mean) * other, d = 0 .. n - 1; ``xm`` is x in the mirrored surface.

    ``mirrored`` is the flat surface with CHUNK more. ``out`` has room for whole chunks; what it holds beyond n, and
    what is read beyond a row, means nothing. ``row`` (2 half + 1,) is scratch.
    """
    size, width = 2 * half + 1, reference.shape[1]
    mean32 = np.float32(mean)
    for d in range(len(out)):
        out[d] = np.float32(0.0)
    for i in range(-half, half + 1):
        left = reference[y + i, x - half : x + half + 1]
        # Mirrored, the block's columns run backwards: column x - j + d lies at xm + j - d.
        for j in range(size):
            row[j] = left[size - 1 - j] - mean32
        for begin in range(0, n, CHUNK):
            sums = out[begin : begin + CHUNK]
            start = (y + i) * width + xm - half + begin
            other = mirrored[start : start + size - 1 + CHUNK]
            # Eight columns at a time: an eighth of the loads and stores of the sums.
            for j in range(0, size - 7, 8):
                a0, a1, a2, a3 = row[j], row[j + 1], row[j + 2], row[j + 3]
                a4, a5, a6, a7 = row[j + 4], row[j + 5], row[j + 6], row[j + 7]
                o = other[j:]
                for d in range(CHUNK):
                    first = (a0 * o[d] + a1 * o[d + 1]) + (a2 * o[d + 2] + a3 * o[d + 3])
                    second = (a4 * o[d + 4] + a5 * o[d + 5]) + (a6 * o[d + 6] + a7 * o[d + 7])
                    sums[d] += first + second
            for j in range(size // 8 * 8, size):
                a0 = row[j]
                o = other[j:]
                for d in range(CHUNK):
                    sums[d] += a0 * o[d]


@njit(cache=True, nogil=True, error_model="numpy")
def _normalise(scores: F32, total: F64, squares: F64, xm: int, y: int, half: int, var_reference: float) -> None:
    """Covariances to correlations: divide by both deviations; -1 where the candidate is flat."""
    n = scores.shape[0]
    area = float((2 * half + 1) ** 2)
    # The block of disparity d lies between columns d and d + size of these rows of the integral images.
    size = 2 * half + 1
    top, bottom = total[y - half, xm - half :], total[y + half + 1, xm - half :]
    top2, bottom2 = squares[y - half, xm - half :], squares[y + half + 1, xm - half :]
    for d in range(n):
        s = bottom[d + size] - top[d + size] - bottom[d] + top[d]
        var = bottom2[d + size] - top2[d + size] - bottom2[d] + top2[d] - s * s / area
        flat = var < _FLAT * area
        root = math.sqrt(var_reference * (1.0 if flat else var))
        scores[d] = np.float32(-1.0 if flat else scores[d] / root)


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def _largest(scores: F32) -> np.float32:
    """The largest of whole chunks of scores, -1 of none."""
    a = b = c = d = np.float32(-1.0)
    # Four at once: each maximum waits for the one before.
    for i in range(0, len(scores), 4):
        a, b = max(a, scores[i]), max(b, scores[i + 1])
        c, d = max(c, scores[i + 2]), max(d, scores[i + 3])
    return max(max(a, b), max(c, d))


@njit(cache=True, nogil=True)
def _first_at(scores: F32, least: np.float32) -> int:
    """The first place of a score of ``least`` or more."""
    size = np.int32(len(scores))
    place = size
    for i in range(size):
        place = min(place, np.int32(i) if scores[i] >= least else size)
    return int(place)


@njit(cache=True, nogil=True, error_model="numpy")
def _peak_offset(scores: F32, best: int) -> np.float32:
    """From ``best`` to the top of the parabola through its score and both neighbours', px; 0 where it has none."""
    before, at, after = scores[best - 1], scores[best], scores[best + 1]
    curvature = before - np.float32(2.0) * at + after
    return np.float32(0.5) * (before - after) / curvature if curvature < 0.0 else np.float32(0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _match(
    reference: Surface,
    mirrored: Surface,
    x: I64,
    y: I64,
    half: int,
    max_disparity: int,
    scores: F32,
    row: F32,
    disparity: F32,
    score: F32,
    second: F32,
    kept: F32,
    enclosed: NDArray[np.bool_],
) -> None:
    """``match`` into the last five arguments; ``scores`` and ``row`` (2 half + 1,) are scratch."""
    h, w = reference.values.shape
    area = (2 * half + 1) ** 2
    for k in range(x.shape[0]):
        xk, yk = int(x[k]), int(y[k])
        disparity[k] = np.nan
        score[k] = np.nan
        second[k] = -1.0
        kept[k] = NONE
        enclosed[k] = False
        # The block must lie inside at x and at x - d.
        if xk < half or xk >= w - half or yk < half or yk >= h - half:
            continue
        sum_l = _block_sum(reference.total, xk, yk, half)
        var_l = _block_sum(reference.total_of_squares, xk, yk, half) - sum_l * sum_l / area
        if var_l < _FLAT * area:
            continue
        xm = w - 1 - xk
        n = min(max_disparity, xk - half) + 1
        # With the usual size as a constant the sums stay in registers.
        if half == USUAL_HALF:
            _correlate(reference.values, mirrored.flat, xk, yk, xm, USUAL_HALF, sum_l / area, n, row, scores)
        else:
            _correlate(reference.values, mirrored.flat, xk, yk, xm, half, sum_l / area, n, row, scores)
        _normalise(scores[:n], mirrored.total, mirrored.total_of_squares, xm, yk, half, var_l)
        scores[n:] = NONE
        kept[k] = scores
        score[k] = _largest(scores)
        best = _first_at(scores, score[k])
        enclosed[k] = 0 < best < n - 1
        disparity[k] = best + (_peak_offset(scores, best) if enclosed[k] else np.float32(0.0))
        scores[max(best - RIVAL_PX, 0) : best + RIVAL_PX + 1] = NONE
        second[k] = _largest(scores)
