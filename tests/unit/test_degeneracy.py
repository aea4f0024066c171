"""Directions that the flows do not constrain: known, covered by the covariance, and nothing wrong is believed."""

import numpy as np
import pytest
from scipy import linalg

from tests.synthetic import CALIBRATION, Motion, errors, messages
from velod.config import from_tree
from velod.optimizer.batch_fit import Fit
from velod.optimizer.degeneracy import TRUSTED, complement, open_directions, weak_directions, without
from velod.optimizer.flow_equation import Measured, Rows
from velod.optimizer.stage import OptimizerStage
from velod.types import Velocity

# Without rotation, so that edges along the image's columns stay along y of B.
DRIFT = Motion(np.zeros(3), np.array([2.0, 1.0, 0.3]), np.array([0.8, 1.2, 0.5]), np.array([3.0, 2.0, 5.0]))


def run(stream, **optimizer):
    stage = OptimizerStage(from_tree({"optimizer": optimizer}), CALIBRATION)
    return [v for m in stream for v in stage.handle(m) if isinstance(v, Velocity)], stage


@pytest.mark.parametrize("noise", [1.0, 0.0])
def test_edges_of_one_direction_leave_the_motion_along_them_to_the_imu(noise):
    """All edges vertical from 0.6 s on: y is flagged, its sigma grows as in darkness, x and z stay known."""
    velocities, stage = run(messages(DRIFT, 1.6, noise=noise, outliers=0.03 * noise, upright_s=(0.6, 1.3)))
    blind = [v for v in velocities if 0.75e9 < v.t_ns <= 1.3e9]
    assert stage.counters["fit.degenerate"] >= 46
    for v in blind:
        assert v.degenerate == 1
        assert abs(v.degenerate_B[0, 1]) > 0.99 and not v.degenerate_B[1:].any()
        assert v.state == "degraded" and "degenerate" in v.reason and v.valid
    first, last = np.sqrt(np.diag(blind[0].cov)), np.sqrt(np.diag(blind[-1].cov))
    assert last[1] > 1.5 * first[1]
    assert last[1] > 2.0 * last[0]
    d = [(v.v_B - DRIFT.v_B(v.t_ns * 1e-9), v.cov) for v in blind]
    assert np.mean([e @ np.linalg.solve(cov, e) for e, cov in d]) < 9.0
    # all directions are back
    assert velocities[-1].degenerate == 0 and velocities[-1].state == "tracking"
    assert errors(velocities[-5:], DRIFT).max() < 0.06


def test_a_start_with_edges_of_one_direction_is_not_called_valid():
    velocities, _ = run(messages(DRIFT, 0.3, upright_s=(0.0, 0.3)))
    assert not any(v.valid for v in velocities)


def test_edges_of_all_directions_are_not_called_degenerate():
    velocities, stage = run(messages(DRIFT, 0.6))
    assert "fit.degenerate" not in stage.counters
    assert {v.degenerate for v in velocities} == {0}


def parallel_rows(rng, m, scatter):
    """Rows of edges along y, and those across them, as measured with normals that scatter by ``scatter`` rad."""
    u, w, Z, f = rng.uniform(-150, 150, m), rng.uniform(-120, 120, m), rng.uniform(2, 6, m), 230.0
    ax, ay = np.stack([-f + 0 * u, 0 * u, u], axis=1), np.stack([0 * u, -f + 0 * u, w], axis=1)
    error = rng.normal(size=m) * scatter
    c, s = np.cos(error)[:, None], np.sin(error)[:, None]
    return (c * ax + s * ay) / Z[:, None], (-s * ax + c * ay) / Z[:, None]


def weak_of(a, across, scatter):
    """Weak directions of rows of equal weight whose normals are said to scatter by ``scatter`` rad."""
    one = np.ones(len(a))
    rows = Rows(np.arange(len(a)), one, a, a, one * 0.1**-0.5)
    fit = Fit(np.zeros(3), np.eye(3), one, 1.0, 1.0)
    return open_directions(rows, Measured(one, one * scatter, one, one), across, fit)


def test_scatter_of_the_normals_is_no_information():
    rng = np.random.default_rng(2)
    a, across = parallel_rows(rng, 400, 0.03)
    weak = weak_of(a, across, 0.03)
    assert weak.shape == (1, 3)
    assert abs(weak[0, 1]) > 0.99
    # a tenth of the edges across the others is enough
    a[::10], across[::10] = across[::10], -a[::10]
    assert weak_of(a, across, 0.03).shape == (0, 3)


def test_weak_directions_are_the_generalised_eigenvectors_below_the_limit():
    rng = np.random.default_rng(5)
    counts = set()
    for _ in range(200):
        A, B = rng.normal(size=(2, 3, 3))
        scatter = A @ A.T + 0.1 * np.eye(3)
        said = B @ np.diag(rng.uniform(0.0, 60.0, 3)) @ B.T
        ratio, vectors = linalg.eigh(said, scatter)
        weak = weak_directions(said, scatter)
        assert len(weak) == np.count_nonzero(ratio < TRUSTED)
        # the same space
        span = vectors[:, : len(weak)]
        assert np.allclose(weak.T @ (weak @ span), span, atol=1e-3)
        counts.add(len(weak))
    assert counts >= {0, 1, 2}


def test_what_is_taken_out_is_what_an_unknown_offset_takes_out():
    """Against the plain marginalisation of a state of (nearly) infinite variance, and nothing is left along it."""
    rng = np.random.default_rng(3)
    A = rng.normal(size=(2, 30, 9))
    L, x = np.einsum("kmi,kmj->kij", A, A), rng.normal(size=9)
    eta = L @ x
    directions = np.linalg.qr(rng.normal(size=(3, 1)))[0].T
    U = np.zeros((9, 1))
    U[:3, 0] = directions[0]
    expected = np.array([Lk - Lk @ U @ np.linalg.inv(U.T @ Lk @ U + 1e-9) @ U.T @ Lk for Lk in L])
    without(L, eta, directions)
    assert np.allclose(L, expected, atol=1e-6)
    assert np.abs(L @ U).max() < 1e-9
    assert np.allclose(eta, L @ x, atol=1e-9)


def test_the_complement_completes_a_basis():
    for k in range(4):
        directions = np.linalg.qr(np.random.default_rng(k).normal(size=(3, 3)))[0][:k]
        basis = np.vstack([directions, complement(directions)])
        assert basis.shape == (3, 3)
        assert np.allclose(basis @ basis.T, np.eye(3), atol=1e-12)
