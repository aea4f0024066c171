"""Directions of the velocity that the flows do not constrain: parallel edges, edges on one line, edges all too far.

A normal flow says nothing of the motion along its edge. Where all edges are parallel, the equations of a batch seem
to determine that direction nevertheless, because the measured normals scatter: an error of a normal lets in a share
of the row across it. What a direction has of information is therefore compared with what that scatter makes of none.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from velod.optimizer.batch_fit import Fit
from velod.optimizer.flow_equation import Measured, Rows
from velod.types import F64

TRUSTED = 3.0
"""Information over that of scattering normals, below which a direction is not believed. Without any signal it is 1;
in sound recordings the weakest direction has 20 to 500, with few flows and motion along one axis 4."""
MAX_DIRECTION_SIGMA = 0.3
"""rad; a flow slower than a few of its sigmas has no direction to speak of."""
MIN_TOLD = 6
"""Flows with a direction, below which there is no telling."""
SINGULAR = 1e-6
"""Of the mean information: what counts as none where the normals do not scatter."""


def open_directions(on_error: Rows, measured: Measured, across: F64, fit: Fit) -> F64:
    """Unit vectors (k, 3) in L of what a batch says nothing of, from its rows and those ``across`` (m, 3)."""
    said, scatter = np.empty((3, 3)), np.empty((3, 3))
    told = _information(
        on_error.a, across, measured.sigma, measured.speed, on_error.sigma, fit.weight, said, scatter
    )  # fmt: skip
    # almost at rest: small flows say that the velocity is small, whichever way they point
    return weak_directions(said, scatter) if told >= MIN_TOLD else np.empty((0, 3))


@njit(cache=True, nogil=True)
def _information(
    a: F64, across: F64, speed_sigma: F64, speed: F64, sigma: F64, weight: F64, said: F64, scatter: F64
) -> int:
    """What rows say of the velocity, (3, 3), and what they would seem to say if their normals only scattered.

    ``a`` (m, 3): n^T A / Z; ``across`` (m, 3): the same for n turned by a right angle. Returns how many flows have a
    direction to speak of.
    """
    said[:, :] = 0.0
    scatter[:, :] = 0.0
    told = 0
    for k in range(speed.size):
        # the plane's slope errs across as much as along
        direction_sigma = speed_sigma[k] / speed[k]
        if not direction_sigma < MAX_DIRECTION_SIGMA:
            continue
        told += 1
        w = weight[k] / (sigma[k] * sigma[k])
        w_across = w * direction_sigma * direction_sigma
        for i in range(3):
            for j in range(3):
                said[i, j] += w * a[k, i] * a[k, j]
                scatter[i, j] += w_across * across[k, i] * across[k, j]
    return told


def weak_directions(said: F64, scatter: F64) -> F64:
    """Unit vectors (k, 3) of the directions in which ``said`` is no more than ``scatter`` explains; orthonormal."""
    floor = SINGULAR * float(said[0, 0] + said[1, 1] + said[2, 2]) / 3.0
    if floor <= 0.0:
        return np.eye(3)
    if _exceeds(said, scatter, TRUSTED, floor):
        return np.empty((0, 3))
    # generalised eigenvalues of (said, scatter): whiten by scatter
    root = np.linalg.cholesky(scatter + floor * np.eye(3))
    half = np.linalg.solve(root, said)
    ratio, vectors = np.linalg.eigh(np.linalg.solve(root, half.T))
    weak = np.linalg.solve(root.T, vectors[:, ratio < TRUSTED])
    return np.ascontiguousarray(np.linalg.qr(weak)[0].T)


@njit(cache=True, nogil=True)
def _exceeds(said: F64, scatter: F64, factor: float, floor: float) -> bool:
    """Whether said - factor (scatter + floor I), (3, 3), is positive definite: no direction is weak."""
    a = said[0, 0] - factor * (scatter[0, 0] + floor)
    d = said[1, 1] - factor * (scatter[1, 1] + floor)
    f = said[2, 2] - factor * (scatter[2, 2] + floor)
    b, c, e = (
        said[0, 1] - factor * scatter[0, 1],
        said[0, 2] - factor * scatter[0, 2],
        said[1, 2] - factor * scatter[1, 2],
    )
    minor = a * d - b * b
    det = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    return bool(a > 0.0 and minor > 0.0 and det > 0.0)


def complement(directions: F64) -> F64:
    """Orthonormal rows (3 - k, 3) across orthonormal ``directions`` (k, 3)."""
    if not len(directions):
        return np.eye(3)
    return np.asarray(np.linalg.svd(np.vstack([directions, np.zeros((1, 3))]))[2][len(directions) :])


def without(L: F64, eta: F64, directions: F64) -> None:
    """Take from informations L (n, s, s), eta (n, s) what they say of the first states along ``directions`` (k, 3).

    All of it, in place. It is as if an unknown offset along them were added to those states.
    """
    U = np.zeros((L.shape[1], len(directions)))
    U[:3] = directions.T
    for Lk, eta_k in zip(L, eta, strict=True):
        LU = Lk @ U
        inner = np.linalg.pinv(U.T @ LU, hermitian=True)
        eta_k -= LU @ (inner @ (U.T @ eta_k))
        Lk -= LU @ inner @ LU.T
