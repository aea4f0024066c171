"""The plane fit against exact planes, against numpy's least squares, and where it must refuse."""

from __future__ import annotations

import numpy as np
import pytest

from velod.events.plane_fit import fit_plane

DX, DY = (a.ravel() for a in np.meshgrid(np.arange(-2, 3), np.arange(-2, 3)))


def plane_ages(gx: float, gy: float, t0: float) -> np.ndarray:
    return -(gx * DX + gy * DY + t0).astype(np.float64)


def twin(age: np.ndarray, reject_px: float, rejections: int, min_neighbours: int) -> tuple[float, ...]:
    """The same fit by numpy's least squares and a boolean mask."""
    kept = age > 0
    for round_ in range(rejections + 1):
        a = np.column_stack([DX, DY, np.ones(25)])[kept]
        if len(a) < max(min_neighbours, 3) or np.linalg.matrix_rank(a) < 3:
            return (0.0,) * 8
        gx, gy, t0 = np.linalg.lstsq(a, -age[kept], rcond=None)[0]
        residual = -age - (gx * DX + gy * DY + t0)
        outlier = kept & (np.abs(residual) > reject_px * np.hypot(gx, gy))
        if round_ == rejections or not outlier.any():
            centred = a[:, :2] - a[:, :2].mean(axis=0)
            q = np.linalg.inv(centred.T @ centred)
            return (kept.sum(), gx, gy, t0, np.sqrt(np.mean(residual[kept] ** 2)), q[0, 0], q[0, 1], q[1, 1])
        kept &= ~outlier
    raise AssertionError("unreachable")


def test_an_exact_plane_is_recovered() -> None:
    n, gx, gy, t0, rms, *_ = fit_plane(plane_ages(1e-3, -2e-3, -0.02), 1.0, 2, 20)
    assert n == 25
    assert (gx, gy, t0) == pytest.approx((1e-3, -2e-3, -0.02), rel=1e-12)
    assert rms < 1e-15


def test_an_outlier_is_rejected_and_the_plane_is_exact_again() -> None:
    age = plane_ages(1e-3, 5e-4, -0.02)
    age[3] += 0.006
    n, gx, gy, t0, *_ = fit_plane(age, 1.0, 2, 20)
    assert n == 24
    assert (gx, gy, t0) == pytest.approx((1e-3, 5e-4, -0.02), rel=1e-12)


def test_without_rejection_the_outlier_stays_and_tilts_the_plane() -> None:
    age = plane_ages(1e-3, 5e-4, -0.02)
    age[3] += 0.006
    n, gx, *_ = fit_plane(age, 1.0, 0, 20)
    assert n == 25
    assert abs(gx - 1e-3) > 5e-5


def test_too_few_neighbours_are_refused() -> None:
    age = plane_ages(1e-3, 0.0, -0.02)
    age[:6] = 0.0
    assert fit_plane(age, 1.0, 2, 20) == (0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert fit_plane(age, 1.0, 2, 19)[0] == 19


def test_too_few_left_after_rejection_are_refused() -> None:
    age = plane_ages(1e-3, 0.0, -0.02)
    age[5] = 0.0
    age[20] += 0.005
    assert fit_plane(age, 1.0, 2, 24)[0] == 0
    assert fit_plane(age, 1.0, 2, 23)[0] == 23


def test_collinear_neighbours_are_refused_as_singular() -> None:
    age = plane_ages(1e-3, 1e-3, -0.02)
    age[DX != DY] = 0.0
    assert fit_plane(age, 1.0, 2, 5)[0] == 0


@pytest.mark.parametrize("seed", range(40))
def test_the_kernel_agrees_with_its_numpy_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi)
    age = plane_ages(2e-3 * np.cos(angle), 2e-3 * np.sin(angle), -0.03) + rng.normal(0, 2e-4, 25)
    age[rng.random(25) < 0.08] += rng.uniform(0.004, 0.01)
    age[rng.random(25) < 0.1] = 0.0
    got = fit_plane(age, 1.0, 2, 6)
    assert got == pytest.approx(twin(age, 1.0, 2, 6), rel=1e-9, abs=1e-15)
    assert got[0] >= 6
