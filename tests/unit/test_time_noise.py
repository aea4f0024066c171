"""The error of the time stamps, told from the planes of a batch by how it goes with their slope."""

from __future__ import annotations

import numpy as np
import pytest

from velod.config import FlowSettings
from velod.events.plane_fit import DX, DY
from velod.events.time_noise import TimeNoise, noise_variance


def patches(rng: np.random.Generator, time_noise_s: float, noise_px: float = 0.15, n: int = 500) -> np.ndarray:
    """(n, 25) ages in ns about edges of 150 to 3000 px/s, as in a fast turn."""
    slope, angle = 1.0 / rng.uniform(150.0, 3000.0, n), rng.uniform(0.0, 2.0 * np.pi, n)
    along = np.cos(angle)[:, None] * DX + np.sin(angle)[:, None] * DY
    t = slope[:, None] * (along + rng.normal(0.0, noise_px, (n, 25))) + rng.normal(0.0, time_noise_s, (n, 25))
    return np.rint((0.05 - t) * 1e9).astype(np.uint32)


@pytest.mark.parametrize("time_noise_us", [50, 200, 500])
def test_the_noise_of_time_stamps_is_found_beside_that_of_the_edges(time_noise_us: int) -> None:
    rng = np.random.default_rng(1)
    noise = TimeNoise(FlowSettings())
    for _ in range(30):
        noise.learn(patches(rng, 1e-6 * time_noise_us))
    assert noise.sigma_ns == pytest.approx(1e3 * time_noise_us, rel=0.15)


def test_exact_time_stamps_are_found_to_be_so_however_rough_the_edges_are() -> None:
    for noise_px in (0.1, 0.15, 0.25):
        rng = np.random.default_rng(2)
        noise = TimeNoise(FlowSettings())
        for _ in range(30):
            noise.learn(patches(rng, 0.0, noise_px))
        # 0.06 px at the fastest of these edges
        assert noise.sigma_ns < 20_000, noise_px


def test_the_noise_is_forgotten_when_it_ends() -> None:
    rng = np.random.default_rng(3)
    noise = TimeNoise(FlowSettings())
    for _ in range(20):
        noise.learn(patches(rng, 3e-4))
    assert noise.sigma_ns > 200_000
    for _ in range(20):
        noise.learn(patches(rng, 0.0))
    assert noise.sigma_ns < 20_000


def test_few_planes_and_none_teach_nothing() -> None:
    rng = np.random.default_rng(4)
    noise = TimeNoise(FlowSettings())
    noise.learn(patches(rng, 5e-4, n=30))
    noise.learn(np.zeros((500, 25), np.uint32))
    assert noise.sigma_ns == 0


def test_planes_of_one_slope_alone_do_not_pass_for_noise() -> None:
    slope2 = np.full(400, 1e-6)
    assert noise_variance(slope2, np.full(400, 0.14**2 * 1e-6)) == 0.0
    assert noise_variance(slope2, np.full(400, 0.3**2 * 1e-6)) < 0.3**2 * 1e-6
