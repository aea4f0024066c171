"""Where along a row an edge passes at a given moment: the places that can be the match of an event.

Block matching asks what looks alike; where neighbours at other distances have moved on by another way, the best
likeness is often that of another edge. But the match of an event is a place where an edge of its polarity passes at
its time. There are few on a row, and of those likeness finds the right one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from velod.depth.zncc import NONE
from velod.events.columns import readonly
from velod.types import F32, F64, I32, I64, NS_PER_S, U8, U16

NOWHERE = -1
"""In place of a disparity, of a point whose row has no such place."""
SAME_PX = 2.0
"""Places this close to each other are one."""


@dataclass(frozen=True, slots=True)
class Passages:
    """Places of all points, those of a point one after the other; each has at least one, which may be NOWHERE."""

    of: I64  # (m,) whose
    disparity: I64  # (m,) px


def sensor_index(remap: tuple[F32, F32], shape: tuple[int, int]) -> I32:
    """(height, width) flat index of the sensor pixel nearest to each rectified one, -1 outside a sensor ``shape``."""
    h, w = shape
    with np.errstate(invalid="ignore"):
        inside = (remap[0] > -0.5) & (remap[0] < w - 0.5) & (remap[1] > -0.5) & (remap[1] < h - 0.5)
    x, y = (np.rint(np.where(inside, m, 0.0)).astype(np.int64) for m in remap)
    return np.where(inside, y * w + x, -1).astype(np.int32)


def passages(
    surface: U16,
    unit_ns: int,
    index: I32,
    x: I64,
    y: I64,
    p: U8,
    t_s: F64,
    reach_s: F64,
    towards: int,
    likeness: tuple[F32, float] | None,
    max_disparity_px: int,
) -> Passages:
    """Places x + ``towards`` d, d = 0 .. max, on the rows y where the edge of polarity p has time ``t_s``.

    ``surface`` (2, h, w): ages in steps of ``unit_ns`` at sensor pixels, which ``index`` (of ``sensor_index``) finds
    for the rectified x and y (n,). A place is a column whose time is nearer than its neighbours' and within
    ``reach_s`` (n,). ``likeness``: correlations (n, k) at whole disparities, and the least that a place has within a
    pixel; None: any.
    """
    scores, min_score = likeness or (np.empty((len(x), 0), np.float32), float(NONE))
    room = len(x) * (max_disparity_px // 2 + 1)
    of, disparity = np.empty(room, np.int64), np.empty(room, np.int64)
    m = _passages(
        readonly(surface, np.uint16).reshape(2, -1),
        unit_ns / NS_PER_S,
        index,
        x,
        y,
        p.astype(np.int64),
        t_s,
        reach_s,
        towards,
        scores,
        min_score,
        np.empty(max_disparity_px + 3),
        of,
        disparity,
    )
    return Passages(of[:m], disparity[:m])


@njit(cache=True, nogil=True)
def _near(scores: F32, d: float) -> float:
    """The best score within a pixel of ``d``: blocks are biased by what is around the edge."""
    middle = round(d)
    best = float(NONE)
    for i in range(max(middle - 1, 0), min(middle + 2, len(scores))):
        best = max(best, float(scores[i]))
    return best


@njit(cache=True, nogil=True)
def _passages(
    surface: U16,
    unit_s: float,
    index: I32,
    x: I64,
    y: I64,
    p: I64,
    t: F64,
    reach: F64,
    towards: int,
    scores: F32,
    min_score: float,
    off: F64,
    of: I64,
    disparity: I64,
) -> int:
    height, width = index.shape
    most = len(off) - 2
    m = 0
    for k in range(len(x)):
        first = m
        # off[d + 1] is that of disparity d; beyond the image there is no place.
        off[:] = math.inf
        if 0 <= y[k] < height and 0 <= x[k] < width:
            row, ages = index[y[k]], surface[p[k]]
            for d in range(min(most, x[k] + 1 if towards < 0 else width - x[k])):
                at = row[x[k] + towards * d]
                age = ages[at] if at >= 0 else np.uint16(0)
                off[d + 1] = abs(age * unit_s + t[k]) if age > 0 else math.inf
        for d in range(most):
            here = off[d + 1]
            passes = here < reach[k] and off[d] >= here and here < off[d + 2]
            if passes and _near(scores[k], d) >= min_score:
                of[m], disparity[m] = k, d
                m += 1
        if m == first:
            of[m], disparity[m] = k, NOWHERE
            m += 1
    return m


@dataclass(frozen=True, slots=True)
class Choice:
    """Of the places of each point."""

    best: I64  # (n,) which looks most alike
    score: F64  # (n,) its correlation, -inf where it is not confirmed
    rival: I64  # (n,) one that could be it as well, -1: none


def choose(places: Passages, disparity: F64, scores: F32, rival_share: float) -> Choice:
    """The best place of each of n points.

    ``disparity`` (m,): of each place, px, NaN where it is not confirmed: such a one is chosen only where none is, and
    is no rival. ``scores`` (n, k): correlation at whole disparities. A rival has ``rival_share`` of the best score.
    """
    n = len(scores)
    out = Choice(np.empty(n, np.int64), np.empty(n), np.empty(n, np.int64))
    _choose(places.of, disparity, scores, rival_share, out.best, out.score, out.rival)
    return out


@njit(cache=True, nogil=True)
def _choose(of: I64, disparity: F64, scores: F32, rival_share: float, best: I64, at_best: F64, rival: I64) -> None:
    m = len(of)
    begin = 0
    for k in range(len(scores)):
        end = begin
        best[k], at_best[k] = begin, -math.inf
        while end < m and of[end] == k:
            if math.isfinite(disparity[end]):
                score = _near(scores[k], disparity[end])
                if score > at_best[k]:
                    best[k], at_best[k] = end, score
            end += 1
        rival[k] = -1
        for i in range(begin, end):
            # False where either is NaN.
            far = abs(disparity[i] - disparity[best[k]]) > SAME_PX
            if far and _near(scores[k], disparity[i]) >= rival_share * at_best[k]:
                rival[k] = i
        begin = end
