"""Whether what surrounds a match is at its distance: beside a jump of depth an edge may be an outline.

An outline moves with the nearer surface while what it uncovers moves with the farther one, and which pixels it
crosses in between is not the passage of one straight edge: neither flow nor depth there is as good as its fit says.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.events.columns import readonly
from velod.types import F64, I32, I64, NS_PER_S, U8, U16

HALF, STEP = 6, 2
"""Of the neighbourhood that is looked at, px: every other pixel of every other row of 13x13."""
SAME_TIME_PX = 1.5
"""An edge passes both cameras at the same time when it does within the time that it needs for this way."""


def unmatched_share(
    left: U16,
    right: U16,
    unit_ns: int,
    left_index: I32,
    right_index: I32,
    x: I64,
    y: I64,
    p: U8,
    disparity: F64,
    tolerance_s: F64,
) -> F64:
    """(n,) share of the pixels around each match where edges of the *other* polarity pass, but not at its disparity.

    ``left`` and ``right`` (2, h, w): ages in steps of ``unit_ns`` at sensor pixels, which the indices (of
    ``passage.sensor_index``) find for rectified ones; x, y (n,) rectified px. A pixel does not match where either
    camera alone saw an edge, or both at times further apart than ``tolerance_s`` (n,). The other polarity, since the
    edge itself always matches; pixels that saw nothing count as matched, as nothing speaks against them.
    """
    out = np.empty(len(x))
    _unmatched_share(
        readonly(left, np.uint16).reshape(2, -1),
        readonly(right, np.uint16).reshape(2, -1),
        left_index,
        right_index,
        x,
        y,
        p.astype(np.int64),
        np.rint(disparity).astype(np.int64),
        tolerance_s * (NS_PER_S / unit_ns),
        out,
    )
    return out


@njit(cache=True, nogil=True)
def _unmatched_share(
    left: U16,
    right: U16,
    left_index: I32,
    right_index: I32,
    x: I64,
    y: I64,
    p: I64,
    disparity: I64,
    tolerance: F64,
    out: F64,
) -> None:
    """``tolerance`` in the unit of the ages."""
    for k in range(len(x)):
        ages_left, ages_right = left[1 - p[k]], right[1 - p[k]]
        seen = unmatched = 0
        for j in range(y[k] - HALF, y[k] + HALF + 1, STEP):
            if not 0 <= j < len(left_index):
                continue
            row_left, row_right = left_index[j], right_index[j]
            for i in range(x[k] - HALF, x[k] + HALF + 1, STEP):
                at = i - disparity[k]
                if not (0 <= i < len(row_left) and 0 <= at < len(row_right)):
                    continue
                at_left, at_right = row_left[i], row_right[at]
                if at_left < 0 or at_right < 0:
                    continue
                seen += 1
                age, other = np.int64(ages_left[at_left]), np.int64(ages_right[at_right])
                # 0 is no event.
                if (age > 0) != (other > 0) or abs(age - other) > tolerance[k]:
                    unmatched += 1
        out[k] = unmatched / max(seen, 1)
