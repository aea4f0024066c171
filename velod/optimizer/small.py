"""Products of small matrices for kernels, where a call of numpy costs more than the arithmetic."""

from __future__ import annotations

from numba import njit

from velod.types import F64


@njit(cache=True, nogil=True)
def multiply(a: F64, b: F64, out: F64) -> None:
    """out = a b."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            s = 0.0
            for k in range(b.shape[0]):
                s += a[i, k] * b[k, j]
            out[i, j] = s


@njit(cache=True, nogil=True)
def add_sandwich(J: F64, P: F64, out: F64) -> None:
    """out += J P J^T."""
    rows, n = J.shape
    for i in range(rows):
        for k in range(n):
            s = 0.0
            for m in range(n):
                s += J[i, m] * P[m, k]
            for j in range(rows):
                out[i, j] += s * J[j, k]
