"""What several batches see of one edge counts once."""

import numpy as np
import pytest

from velod.config import IngestSettings
from velod.optimizer.batch_fit import solve
from velod.optimizer.bins import compress
from velod.optimizer.flow_equation import Rows
from velod.optimizer.overlap import counted_once, times_seen

INGEST = IngestSettings(period_ms=10.0, memory_ms=100.0)
E = np.array([0.3, -0.2, 0.1])


def rows(rng: np.random.Generator, sigma: float = 2.0, m: int = 300) -> Rows:
    a = rng.normal(size=(m, 3)) * 40.0
    z = a @ E + rng.normal(size=m) * sigma
    return Rows(np.zeros(m, np.int64), z, a, np.zeros((m, 3)), np.full(m, sigma))


def test_an_edge_is_seen_for_as_long_as_it_crosses_seven_pixels_within_the_memory():
    speed = np.array([7000.0, 700.0, 350.0, -350.0, 100.0, 5.0])
    assert times_seen(speed, INGEST) == pytest.approx([1.0, 1.0, 2.0, 2.0, 7.0, 10.0])


def test_fast_edges_keep_what_they_say():
    r = rows(np.random.default_rng(1))
    np.testing.assert_array_equal(counted_once(r, times_seen(np.full(300, 900.0), INGEST)).sigma, r.sigma)


def test_five_batches_that_repeat_one_measurement_say_no_more_than_it():
    times, nees, nees_if_independent = np.full(300, 5.0), [], []
    for seed in range(100):
        r = rows(np.random.default_rng(seed))
        fit = solve(r, 20, 1)
        assert fit is not None
        for seen, out in ((counted_once(r, times), nees), (r, nees_if_independent)):
            bins = compress(seen, np.zeros((300, 3)), fit, 1.0, np.zeros(3))
            L, eta = 5.0 * bins.L.sum(axis=0)[:3, :3], 5.0 * bins.eta.sum(axis=0)[:3]
            error = np.linalg.solve(L, eta) - E
            out.append(error @ L @ error)
    # 3, and some 5 % for the robust weights; 0.25 is one sigma of a mean over 100 draws
    assert 2.4 < np.mean(nees) < 3.8
    assert np.mean(nees_if_independent) > 4.0 * np.mean(nees)
