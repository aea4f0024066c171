"""Cholesky's factor of a matrix with an envelope, against numpy."""

import numpy as np
import pytest

from velod.optimizer import envelope

N, HALF_BAND = 21, 6


def banded(seed, n=N):
    """A positive definite matrix that is zero beyond HALF_BAND of its diagonal, and where its rows end."""
    rng = np.random.default_rng(seed)
    root = np.triu(rng.normal(size=(n, n)))
    root[np.subtract.outer(np.arange(n), np.arange(n)) < -HALF_BAND] = 0.0
    H = root.T @ root + 0.1 * np.eye(n)
    return H, np.minimum(np.arange(n) + HALF_BAND + 1, n)


def factor_of(H, end, stop=None):
    """U with its rows' ends, and whether H was definite."""
    U, last = np.full_like(H, np.nan), end.copy()
    envelope.copy(H, end, 0, len(H), U)
    return U, last, envelope.factorise(U, last, 0, len(H) if stop is None else stop)


@pytest.mark.parametrize("seed", range(5))
def test_the_factor_and_both_substitutions_are_those_of_dense_algebra(seed):
    H, end = banded(seed)
    U, last, definite = factor_of(H, end)
    assert definite
    np.testing.assert_allclose(np.triu(U), np.linalg.cholesky(H).T, atol=1e-12)
    b = np.random.default_rng(seed).normal(size=N)
    x = b.copy()
    envelope.forward(U, last, x, 0, N)
    np.testing.assert_allclose(np.triu(U).T @ x, b, atol=1e-12)
    envelope.backward(U, last, x)
    np.testing.assert_allclose(H @ x, b, atol=1e-10)


@pytest.mark.parametrize("stop", [3, 9, 18])
def test_what_is_left_of_an_elimination_is_the_schur_complement(stop):
    H, end = banded(7)
    U, last, _ = factor_of(H, end, stop)
    b = np.arange(1.0, N + 1.0)
    x = b.copy()
    envelope.forward(U, last, x, 0, stop)
    gain = H[stop:, :stop] @ np.linalg.inv(H[:stop, :stop])
    np.testing.assert_allclose(
        np.triu(U[stop:, stop:]), np.triu(H[stop:, stop:] - gain @ H[:stop, stop:]), atol=1e-12
    )
    np.testing.assert_allclose(x[stop:], b[stop:] - gain @ b[:stop], atol=1e-11)


def test_the_covariance_of_some_combinations_is_that_of_the_inverse():
    H, end = banded(8)
    U, last, _ = factor_of(H, end)
    F = np.zeros((4, N))
    F[0, 2:9], F[1, 20], F[2, 15:] = 0.5, 1.0, np.arange(6.0)  # the last row asks for nothing
    out = np.ones((4, 4))
    envelope.add_covariance(U, last, F.copy(), out)
    np.testing.assert_allclose(out, 1.0 + F @ np.linalg.inv(H) @ F.T, atol=1e-12)


@pytest.mark.parametrize("k", [0, 10, 20])
def test_a_matrix_that_is_not_definite_is_refused(k):
    H, end = banded(9)
    H[k, k] = -1.0
    assert not factor_of(H, end)[2]
