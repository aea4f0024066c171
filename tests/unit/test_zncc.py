"""Block matching against its plain numpy twin, and the time surfaces under it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from velod.depth.time_surface import TimeSurface, decay_table
from velod.depth.zncc import NONE, Surface, match

H, W, BLOCK, MAX_D = 40, 70, 9, 16


def twin(left: np.ndarray, right: np.ndarray, x: int, y: int) -> np.ndarray:
    """ZNCC at every disparity whose blocks lie inside both images."""
    k = BLOCK // 2
    if not (k <= x < W - k and k <= y < H - k):
        return np.empty(0)
    a = left[y - k : y + k + 1, x - k : x + k + 1].astype(np.float64)
    scores = []
    for d in range(min(MAX_D, x - k) + 1):
        b = right[y - k : y + k + 1, x - d - k : x - d + k + 1].astype(np.float64)
        scores.append(np.corrcoef(a.ravel(), b.ravel())[0, 1])
    return np.array(scores)


def twin_peak(scores: np.ndarray) -> tuple[float, float, float, bool]:
    """(disparity, score, second, enclosed) of a list of scores."""
    if not len(scores):
        return np.nan, np.nan, -1.0, False
    d = int(np.argmax(scores))
    others = scores[np.abs(np.arange(len(scores)) - d) > 2]
    enclosed = 0 < d < len(scores) - 1
    offset = 0.0
    if enclosed:
        before, at, after = scores[d - 1 : d + 2]
        offset = 0.5 * (before - after) / (before - 2 * at + after)
    return d + offset, scores[d], max(others.max(initial=-1.0), -1.0), enclosed


@given(st.integers(0, 2**32 - 1))
def test_matches_equal_the_numpy_twins(seed: int) -> None:
    rng = np.random.default_rng(seed)
    left = rng.random((H, W), dtype=np.float32)
    right = (np.roll(left, -int(rng.integers(0, MAX_D)), axis=1) + 0.5 * rng.random((H, W))).astype(np.float32)
    x, y = rng.integers(-2, W + 2, 30), rng.integers(-2, H + 2, 30)
    out = match(Surface.of(left), Surface.of(np.ascontiguousarray(right[:, ::-1])), x, y, BLOCK, MAX_D)
    for i in range(30):
        disparity, score, second, enclosed = twin_peak(twin(left, right, int(x[i]), int(y[i])))
        np.testing.assert_allclose(out.disparity[i], disparity, atol=2e-3)
        np.testing.assert_allclose(out.score[i], score, atol=1e-4)
        np.testing.assert_allclose(out.second[i], second, atol=1e-4)
        assert out.enclosed[i] == enclosed
        scores = twin(left, right, int(x[i]), int(y[i]))
        np.testing.assert_allclose(out.scores[i, : len(scores)], scores, atol=1e-4)
        assert (out.scores[i, len(scores) :] == NONE).all()


def test_matching_back_finds_the_same_disparity() -> None:
    rng = np.random.default_rng(0)
    left = rng.random((H, W), dtype=np.float32)
    right = np.roll(left, -6, axis=1)
    L, R_mirrored = Surface.of(left), Surface.of(np.ascontiguousarray(right[:, ::-1]))
    x, y = np.array([30, 40, 50]), np.array([10, 20, 30])
    there = match(L, R_mirrored, x, y, BLOCK, MAX_D)
    back = match(R_mirrored, L, W - 1 - (x - 6), y, BLOCK, MAX_D)
    np.testing.assert_allclose(there.disparity, 6.0, atol=0.1)
    np.testing.assert_allclose(back.disparity, 6.0, atol=0.1)


def test_a_flat_block_has_no_match() -> None:
    flat = Surface.of(np.full((H, W), 0.5, np.float32))
    textured = Surface.of(np.random.default_rng(0).random((H, W), dtype=np.float32))
    x, y = np.array([30]), np.array([20])
    assert np.isnan(match(flat, textured, x, y, BLOCK, MAX_D).disparity).all()
    assert match(textured, flat, x, y, BLOCK, MAX_D).score[0] == -1.0


def test_the_decay_is_exponential_in_age_and_zero_where_nothing_happened() -> None:
    table = decay_table(unit_ns=1000, tau_s=0.02)
    assert table[0] == 0.0
    np.testing.assert_allclose(table[[1, 20_000, 65_535]], np.exp([-5e-5, -1.0, -3.27675]), rtol=1e-6)


@pytest.mark.parametrize("remapped", [False, True])
def test_a_mirrored_surface_is_the_surface_mirrored(remapped: bool) -> None:
    rng = np.random.default_rng(0)
    ages = rng.integers(0, 65536, (20, 30)).astype(np.uint16)
    x, y = np.meshgrid(np.arange(30, dtype=np.float32) + 0.25, np.arange(20, dtype=np.float32))
    x[3, 4] = np.nan
    maps = (x, y) if remapped else None
    table = decay_table(1526, 0.02)
    plain, mirrored = TimeSurface(maps).render(ages, table), TimeSurface(maps, mirrored=True).render(ages, table)
    np.testing.assert_array_equal(mirrored, plain[:, ::-1])
    if remapped:
        assert plain[3, 4] == 0.0
        expected = 0.75 * table[ages[5, 6]] + 0.25 * table[ages[5, 7]]
        assert plain[5, 6] == pytest.approx(expected, abs=1e-4)
