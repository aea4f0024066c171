"""The plane fit against exact planes, against numpy's least squares, and where it must refuse."""

from __future__ import annotations

import math

import numpy as np
import pytest

from velod.events.plane_fit import NOISE_RMS2, fit_plane, honest_rms, rms_px, widen_plane

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


WIDE_DX, WIDE_DY = (a.ravel() for a in np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)))
CORE = (np.abs(WIDE_DX) <= 2) & (np.abs(WIDE_DY) <= 2)


def noisy_wide_ages(seed: int, noise_px: float = 0.15, slope: float = 2e-3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi)
    along = np.cos(angle) * WIDE_DX + np.sin(angle) * WIDE_DY
    return 0.05 - slope * (along + rng.normal(0, noise_px, 49))


def widened_twin(fit: tuple[float, ...], age: np.ndarray, reject_px: float) -> tuple[float, ...]:
    """The same plane by numpy's least squares on what lies near the first one."""
    a = np.column_stack([WIDE_DX, WIDE_DY, np.ones(49)])
    near = (age > 0) & (np.abs(-age - a @ np.array(fit[1:4])) <= reject_px * np.hypot(fit[1], fit[2]))
    gx, gy, t0 = np.linalg.lstsq(a[near], -age[near], rcond=None)[0]
    residual = -age[near] - a[near] @ [gx, gy, t0]
    centred = a[near, :2] - a[near, :2].mean(axis=0)
    q = np.linalg.inv(centred.T @ centred)
    return (near.sum(), gx, gy, t0, np.sqrt(np.mean(residual**2)), q[0, 0], q[0, 1], q[1, 1])


@pytest.mark.parametrize("seed", range(20))
def test_the_widened_plane_agrees_with_its_numpy_twin(seed: int) -> None:
    age = noisy_wide_ages(seed)
    rng = np.random.default_rng(seed)
    age[~CORE & (rng.random(49) < 0.2)] = 0.0
    age[~CORE & (rng.random(49) < 0.2)] += 0.02
    fit = fit_plane(age[CORE], 1.0, 2, 20)
    got, *_ = widen_plane(fit, age, 1.0, 0.35)
    assert got == pytest.approx(widened_twin(fit, age, 1.0), rel=1e-7, abs=1e-13)
    assert 25 < got[0] < 49


def test_another_edge_around_a_plane_does_no_harm() -> None:
    age = noisy_wide_ages(1, noise_px=0.0)
    age[WIDE_DX > 2] -= 0.02
    got, *_ = widen_plane(fit_plane(age[CORE], 1.0, 2, 20), age, 1.0, 0.35)
    assert got[0] == 42
    assert np.hypot(got[1], got[2]) == pytest.approx(2e-3, rel=1e-9)


def test_what_is_no_plane_in_the_wide_stays_as_it_was_found() -> None:
    age = noisy_wide_ages(2, noise_px=0.0)
    rng = np.random.default_rng(2)
    age[~CORE] += rng.choice([-1.0, 1.0], 24) * 0.9 * 2e-3
    fit = fit_plane(age[CORE], 1.0, 2, 20)
    assert widen_plane(fit, age, 1.0, 0.35) == (fit, 0.0, fit[4])
    assert widen_plane(fit, age, 1.0, 0.9)[0] != fit


@pytest.mark.parametrize("seed", range(5))
def test_a_bend_along_the_slope_is_told_and_one_along_the_edge_is_none(seed: int) -> None:
    flat = noisy_wide_ages(seed, noise_px=0.0)
    fit = fit_plane(flat[CORE], 1.0, 2, 20)
    normal = np.array(fit[1:3]) / np.hypot(fit[1], fit[2])
    along = normal @ [WIDE_DX, WIDE_DY]
    across = np.array([-normal[1], normal[0]]) @ [WIDE_DX, WIDE_DY]
    for way, told in ((along, 1.0), (across, 0.0)):
        age = flat - 5e-5 * way**2
        _, bend, slope_rms = widen_plane(fit_plane(age[CORE], 1.0, 2, 20), age, 2.0, 0.9)
        assert bend == pytest.approx(told * 5e-5, abs=0.25 * 5e-5)
        assert slope_rms < 1e-9, "no bend moves the slope"


@pytest.mark.parametrize("seed", range(5))
def test_what_the_slope_errs_by_follows_from_the_residuals_of_a_fit_with_bends(seed: int) -> None:
    age = noisy_wide_ages(seed)
    fit, _, slope_rms = widen_plane(fit_plane(age[CORE], 1.0, 2, 20), age, 1.0, 0.35)
    assert fit[0] == 49
    x, y = WIDE_DX.astype(float), WIDE_DY.astype(float)
    bent = np.column_stack([np.ones(49), x, y, x * x, x * y, y * y])
    (rss,) = np.linalg.lstsq(bent, -age, rcond=None)[1]
    assert slope_rms == pytest.approx(np.sqrt(rss / 49 * 46 / 43), rel=1e-6)
    age[0] = 0.0
    fit, _, slope_rms = widen_plane(fit_plane(age[CORE], 1.0, 2, 20), age, 1.0, 0.35)
    assert slope_rms == fit[4], "with a neighbour missing a bend does move the slope"


def test_widening_halves_the_scatter_of_the_slope() -> None:
    narrow, wide = [], []
    for seed in range(400):
        age = noisy_wide_ages(seed)
        fit = fit_plane(age[CORE], 1.0, 2, 20)
        narrow.append(np.hypot(fit[1], fit[2]))
        wide.append(np.hypot(*widen_plane(fit, age, 1.0, 0.35)[0][1:3]))
    # The sums of squared distances are 50 and 196 px^2.
    assert np.std(wide) == pytest.approx(np.std(narrow) * np.sqrt(50 / 196), rel=0.15)


def test_residuals_count_as_measured_but_for_what_is_usual() -> None:
    slope = 2e-3
    many, few = honest_rms(10_000, 0.3 * slope, slope), honest_rms(20, 0.01 * slope, slope)
    assert many == pytest.approx(0.3 * slope, rel=1e-3)
    assert few == pytest.approx(slope * np.sqrt((20 * 0.01**2 + 10 * 0.15**2) / 27), rel=1e-12)


def test_what_the_time_stamps_account_for_is_no_residual_of_the_plane() -> None:
    assert rms_px(5e-4, 1e-6, 0.0) == pytest.approx(0.5)
    assert rms_px(5e-4, 1e-6, 3e-4) == pytest.approx(np.sqrt(0.25 - NOISE_RMS2 * 0.09))
    assert rms_px(1e-4, 1e-6, 3e-4) == 0.0
    assert rms_px(1e-4, 0.0, 3e-4) == math.inf


def test_a_gate_that_knows_of_the_time_noise_does_not_favour_slow_planes() -> None:
    """2000 px/s and stamps that are off by 0.5 ms, a pixel's way: without, what passes is 9 % too slow."""
    slopes: dict[float, list[float]] = {0.0: [], 5e-4: []}
    for seed in range(3000):
        age = noisy_wide_ages(seed, noise_px=1.0, slope=5e-4)
        for noise_s, passed in slopes.items():
            fit = fit_plane(age[CORE], 1.0, 2, 20, noise_s)
            n, gx, gy, _, rms, *_ = widen_plane(fit, age, 1.0, 0.35, noise_s)[0] if fit[0] else fit
            if n and rms_px(rms, gx * gx + gy * gy, noise_s) < 0.35:
                passed.append(np.hypot(gx, gy))
    assert np.median(slopes[0.0]) > 1.05 * 5e-4
    assert np.median(slopes[5e-4]) == pytest.approx(5e-4, rel=0.02)
    assert len(slopes[5e-4]) > 2000 > 4 * len(slopes[0.0])
