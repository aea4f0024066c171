"""Where edges pass with an event, and which of those places is its match: kernels against their plain twins."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.moving_edge import PLAIN_RIG, UNIT_NS, Edge, batch
from velod.depth.passage import NOWHERE, Passages, choose, passages, sensor_index
from velod.depth.refine import left_edges
from velod.depth.zncc import NONE
from velod.geometry.rectify import rectify

H, W, MAX_D = 12, 60, 20
SEEDS = st.integers(0, 2**32 - 1)


def likeness(scores: np.ndarray, d: float) -> float:
    """The best score at the whole disparities within a pixel of the nearest one."""
    near = np.abs(np.arange(len(scores)) - np.rint(d)) <= 1
    return float(scores[near].max(initial=NONE))


def places_of(
    ages_s: np.ndarray,
    index: np.ndarray,
    x: int,
    y: int,
    t_s: float,
    reach_s: float,
    towards: int,
    scores: np.ndarray,
) -> list[int]:
    """Twin of ``passages`` for one point; ``ages_s`` (h, w) of its polarity, 0: none."""
    off = np.full(MAX_D + 3, np.inf)
    for d in range(MAX_D + 1):
        column = x + towards * d
        if 0 <= y < len(index) and 0 <= column < index.shape[1] and 0 <= x < index.shape[1] and index[y, column] >= 0:
            age = ages_s.ravel()[index[y, column]]
            off[d + 1] = abs(age + t_s) if age > 0 else np.inf
    return [
        d
        for d in range(MAX_D + 1)
        if off[d + 1] < reach_s and off[d] >= off[d + 1] < off[d + 2] and likeness(scores, d) >= 0.3
    ] or [NOWHERE]


@given(SEEDS, st.sampled_from([-1, 1]))
def test_the_places_equal_those_of_the_twin(seed: int, towards: int) -> None:
    rng = np.random.default_rng(seed)
    surface = rng.integers(1, 8000, (2, H, W)).astype(np.uint16) * (rng.random((2, H, W)) < 0.8)
    index = np.where(rng.random((H, W)) < 0.9, rng.permutation(H * W).reshape(H, W), -1).astype(np.int32)
    n = 20
    x, y, p = rng.integers(-3, W + 3, n), rng.integers(-1, H + 1, n), rng.integers(0, 2, n).astype(np.uint8)
    t_s, reach_s = -rng.uniform(0.0, 0.012, n), rng.uniform(0.0, 0.004, n)
    scores = rng.uniform(-1.0, 1.0, (n, MAX_D + 4)).astype(np.float32)
    surface = surface.astype(np.uint16)
    found = passages(surface, UNIT_NS, index, x, y, p, t_s, reach_s, towards, (scores, 0.3), MAX_D)
    assert (np.diff(found.of) >= 0).all()
    for k in range(n):
        ages_s = surface[p[k]] * (UNIT_NS / 1e9)
        expected = places_of(ages_s, index, int(x[k]), int(y[k]), t_s[k], reach_s[k], towards, scores[k])
        assert found.disparity[found.of == k].tolist() == expected


@given(SEEDS)
def test_the_choice_equals_that_of_the_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    of = np.repeat(np.arange(15), rng.integers(1, 5, 15))
    disparity = np.where(rng.random(len(of)) < 0.7, rng.uniform(0.0, MAX_D, len(of)), np.nan)
    scores = rng.uniform(-1.0, 1.0, (15, MAX_D + 4)).astype(np.float32)
    choice = choose(Passages(of, np.zeros_like(of)), disparity, scores, 0.75)
    best, rival = choice.best, choice.rival
    for k in range(15):
        own = np.flatnonzero(of == k)
        confirmed = [i for i in own if np.isfinite(disparity[i])]
        if not confirmed:
            assert (best[k], rival[k], choice.score[k]) == (own[0], -1, -np.inf)
            continue
        at = {i: likeness(scores[k], disparity[i]) for i in confirmed}
        assert best[k] == max(confirmed, key=lambda i: (at[i], -i))
        assert choice.score[k] == at[best[k]]
        others = [i for i in confirmed if abs(disparity[i] - disparity[best[k]]) > 2.0]
        others = [i for i in others if at[i] >= 0.75 * at[best[k]]]
        assert rival[k] == (others[-1] if others else -1)


def test_of_several_edges_only_the_one_that_passes_then_is_a_place() -> None:
    """Ten edges of one speed: in the right image one of them lies where the event's edge does at the event's time."""
    edges = [Edge(x_px=190.0 - 13.0 * k, angle=0.1, disparity_px=9.0) for k in range(10)]
    message, rect = batch(*edges, points=60), rectify(PLAIN_RIG)
    found = left_edges(message.left, UNIT_NS, message.x, message.y, message.p, rect)
    x, y = np.rint(found.x).astype(np.int64), np.rint(found.y).astype(np.int64)
    index = sensor_index(rect.remap_right, (180, 240))
    places = passages(
        message.right, UNIT_NS, index, x, y, message.p, found.t_s, np.full(60, 1.0 / 300.0), -1, None, 48
    )
    usable = np.isfinite(found.t_s)
    assert usable.sum() > 40
    for k in np.flatnonzero(usable):
        # Edges follow each other every 13 px along the row; they passed this far from here at the same moment.
        own = places.disparity[places.of == k]
        assert np.abs(own - 9).min() <= 1
        assert len(own) <= 4


@pytest.mark.parametrize("outside", [-0.6, 239.7, np.nan])
def test_rectified_pixels_off_the_sensor_have_no_index(outside: float) -> None:
    x, y = np.meshgrid(np.arange(4, dtype=np.float32), np.arange(3, dtype=np.float32))
    x[1, 2] = outside
    index = sensor_index((x, y), (180, 240))
    assert index[1, 2] == -1
    assert index[2, 3] == 2 * 240 + 3
