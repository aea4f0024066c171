"""Small matrices and medians for kernels, against numpy."""

import numpy as np
import pytest

from velod.optimizer.small import add_sandwich, median, multiply, squared_distance


@pytest.mark.parametrize("n", [1, 2, 3, 8, 9, 501, 500])
def test_the_median_is_numpys(n):
    rng = np.random.default_rng(n)
    for values in (rng.normal(size=n), np.round(rng.normal(size=n)), np.arange(n, 0.0, -1.0), np.zeros(n)):
        assert median(values.copy()) == np.median(values)


def test_products_are_numpys():
    rng = np.random.default_rng(0)
    a, b, J = rng.normal(size=(3, 4)), rng.normal(size=(4, 5)), rng.normal(size=(3, 4))
    out = np.empty((3, 5))
    multiply(a, b, out)
    assert np.allclose(out, a @ b)
    P, total = b @ b.T, np.eye(3)
    add_sandwich(J, P, total)
    assert np.allclose(total, np.eye(3) + J @ P @ J.T)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_squared_distance_is_that_of_dense_algebra(n):
    rng = np.random.default_rng(n)
    d, root = rng.normal(size=n), rng.normal(size=(n, n))
    S = root @ root.T + 0.1 * np.eye(n)
    assert np.isclose(squared_distance(d, S), d @ np.linalg.solve(S, d))
