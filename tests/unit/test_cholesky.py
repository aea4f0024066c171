"""Cholesky's factor for kernels, against numpy."""

import numpy as np
import pytest

from velod.geometry.cholesky import backward, factorise, forward


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_the_factor_and_both_substitutions_are_those_of_dense_algebra(n):
    rng = np.random.default_rng(n)
    root, b = rng.normal(size=(n, n)), rng.normal(size=n)
    H = root @ root.T + 0.1 * np.eye(n)
    L, x = H.copy(), b.copy()
    factorise(L)
    assert np.allclose(np.tril(L), np.linalg.cholesky(H))
    forward(L, x)
    assert np.allclose(np.tril(L) @ x, b)
    backward(L, x)
    assert np.allclose(H @ x, b)
