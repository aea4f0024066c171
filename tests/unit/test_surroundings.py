"""Whether the surroundings of a match are at its distance: kernels against plain twins, and a scene with a jump."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.moving_edge import UNIT_NS
from velod.depth.surroundings import HALF, STEP, unmatched_share

H, W = 30, 60
INDEX = np.arange(H * W, dtype=np.int32).reshape(H, W)
SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS)
def test_the_unmatched_share_equals_that_of_the_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    left, right = (rng.integers(0, 40, (2, H, W)).astype(np.uint16) * np.uint16(500) for _ in range(2))
    index = np.where(rng.random((H, W)) < 0.9, INDEX, np.int32(-1))
    n = 12
    x, y, p = rng.integers(0, W, n), rng.integers(0, H, n), rng.integers(0, 2, n).astype(np.uint8)
    disparity, tolerance_s = rng.uniform(0.0, 12.0, n), rng.uniform(0.0, 0.01, n)
    got = unmatched_share(left, right, UNIT_NS, INDEX, index, x, y, p, disparity, tolerance_s)
    for k in range(n):
        j, i = (
            v.ravel() for v in np.mgrid[y[k] - HALF : y[k] + HALF + 1 : STEP, x[k] - HALF : x[k] + HALF + 1 : STEP]
        )
        other = i - int(np.rint(disparity[k]))
        inside = (j >= 0) & (j < H) & (i >= 0) & (i < W) & (other >= 0) & (other < W)
        j, i, other = j[inside], i[inside], other[inside]
        known = index[j, other] >= 0
        a, b = (
            left[1 - p[k], j, i][known].astype(np.int64),
            right[1 - p[k], j, other][known].astype(np.int64),
        )
        apart = ((a > 0) ^ (b > 0)) | (np.abs(a - b) * (UNIT_NS / 1e9) > tolerance_s[k])
        np.testing.assert_allclose(got[k], apart.mean() if len(apart) else 0.0, atol=1e-12)


def test_nothing_speaks_against_a_match_on_one_surface_and_most_does_beside_another() -> None:
    """OFF edges pass every 6 px; those right of column 30 have another disparity and speed."""
    x = np.arange(W)

    def passed(offset_px: float, period_px: float) -> np.ndarray:
        return (1 + 400 * ((x + offset_px) % period_px)).astype(np.uint16)

    left, right = np.zeros((2, 2, H, W), np.uint16)
    left[0] = passed(0.0, 6.0)
    right[0] = passed(5.0, 6.0)
    right[0][:, 25:] = passed(2.5, 7.0)[25:]
    at = np.array([15, 45])
    share = unmatched_share(
        left, right, UNIT_NS, INDEX, INDEX, at, np.array([15, 15]), np.ones(2, np.uint8), np.full(2, 5.0),
        np.full(2, 300 * UNIT_NS / 1e9),
    )  # fmt: skip
    assert share[0] == 0.0
    assert share[1] > 0.7
