"""Products of small matrices for kernels, where a call of numpy costs more than the arithmetic."""

from __future__ import annotations

from numba import njit

from velod.geometry.cholesky import factorise, forward
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


@njit(cache=True, nogil=True)
def median(values: F64) -> float:
    """Of values (n,), n > 0, which are reordered on the way (quickselect)."""
    n = values.size
    low, high, middle = 0, n - 1, n // 2
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            break
    upper = values[middle]
    if n % 2:
        return float(upper)
    lower = values[0]
    for k in range(middle):
        lower = max(lower, values[k])
    return 0.5 * float(lower + upper)


@njit(cache=True, nogil=True)
def squared_distance(d: F64, S: F64) -> float:
    """d^T S^-1 d for d (n,) and symmetric, positive definite S (n, n), by Cholesky's factor."""
    root, y, total = S.copy(), d.copy(), 0.0
    factorise(root)
    forward(root, y)
    for i in range(y.size):
        total += y[i] * y[i]
    return total


@njit(cache=True, nogil=True)
def invert3(a: F64, out: F64) -> None:
    """out = a^-1 for symmetric, positive definite a (3, 3), by cofactors."""
    out[0, 0] = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    out[0, 1] = a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2]
    out[0, 2] = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    out[1, 1] = a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0]
    out[1, 2] = a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]
    out[2, 2] = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    det = a[0, 0] * out[0, 0] + a[0, 1] * out[0, 1] + a[0, 2] * out[0, 2]
    for i in range(3):
        for j in range(i, 3):
            out[i, j] /= det
            out[j, i] = out[i, j]
