"""Cholesky's factor for kernels: of small, dense matrices, in place."""

from __future__ import annotations

import math

from numba import njit

from velod.types import F64


@njit(cache=True, nogil=True)
def factorise(H: F64) -> None:
    """H = L L^T for positive definite H (n, n), given by its lower triangle, which becomes L."""
    for i in range(len(H)):
        for j in range(i + 1):
            s = H[i, j]
            for k in range(j):
                s -= H[i, k] * H[j, k]
            H[i, j] = math.sqrt(s) if i == j else s / H[j, j]


@njit(cache=True, nogil=True)
def forward(L: F64, x: F64) -> None:
    """x <- L^-1 x for x (n,)."""
    for i in range(len(x)):
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]


@njit(cache=True, nogil=True)
def backward(L: F64, x: F64) -> None:
    """x <- L^-T x for x (n,)."""
    for i in range(len(x) - 1, -1, -1):
        for k in range(i + 1, len(x)):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
