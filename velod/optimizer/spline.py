"""The uniform cubic B-spline of Eq. 7."""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.types import F64

DEGREE = 3
"""The paper's "order k"; a spline of ``n_ctrl`` control points has ``n_ctrl - 3`` segments (Eq. 12, corrected)."""


def basis(u: float) -> F64:
    """The four B_{i,3}(u) of Eq. 7 for 0 <= u <= 1 within a segment, shape (4,); they sum to 1."""
    out = np.empty(4)
    fill_basis(u, out)
    return out


@njit(cache=True, nogil=True)
def fill_basis(u: float, out: F64) -> None:
    """``basis`` into out (4,)."""
    u2 = u * u
    u3 = u2 * u
    out[0] = (1.0 - 3.0 * u + 3.0 * u2 - u3) / 6.0
    out[1] = (4.0 - 6.0 * u2 + 3.0 * u3) / 6.0
    out[2] = (1.0 + 3.0 * u + 3.0 * u2 - 3.0 * u3) / 6.0
    out[3] = u3 / 6.0


def locate(t_ns: int, knot_ns: int) -> tuple[int, float]:
    """Segment of time ``t_ns`` on the knots at multiples of ``knot_ns``, and u in [0, 1) within it.

    Segment k is governed by control points k .. k + 3.
    """
    k = t_ns // knot_ns
    return int(k), (t_ns - k * knot_ns) / knot_ns
