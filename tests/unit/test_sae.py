"""Surfaces of active events: the refractory rule, encoding and gathering, each against a plain twin."""

from __future__ import annotations

import numpy as np
import pytest

from velod.events.sae import BLOCK, NEVER, age_unit_ns, encode_ages, encode_newest, gather_patches, update_sae
from velod.events.surface_clock import EMPTY, new_surface

MS = 1_000_000


def enter(times_ms: list[int], refractory_ms: int, p: int = 1) -> tuple[np.ndarray, np.ndarray]:
    first, last = new_surface(8, 9), new_surface(8, 9)
    n = len(times_ms)
    x, y = np.full(n, 3, np.uint16), np.full(n, 2, np.uint16)
    update_sae(x, y, np.array(times_ms) * MS, np.full(n, p, np.uint8), first, last, refractory_ms * MS)
    return first, last


def test_a_burst_keeps_its_first_event_and_its_last() -> None:
    first, last = enter([100, 104, 112, 121], 10)
    assert first[1, 2, 3] == 100 * MS
    assert last[1, 2, 3] == 121 * MS


def test_an_event_after_the_refractory_time_starts_a_new_burst() -> None:
    first, _ = enter([100, 104, 114], 10)
    assert first[1, 2, 3] == 114 * MS


def test_without_a_refractory_time_every_event_is_a_first() -> None:
    first, last = enter([100, 100, 104], 0)
    assert np.array_equal(first, last)


def test_the_polarities_have_their_own_surfaces() -> None:
    first, last = enter([100], 10, p=0)
    assert first[0, 2, 3] == 100 * MS
    assert (first[1] == EMPTY).all() and (last[1] == EMPTY).all()


def test_the_kernel_agrees_with_its_plain_twin() -> None:
    rng = np.random.default_rng(1)
    n, refractory = 4000, 3000
    assert n > 2 * BLOCK
    x, y = rng.integers(0, 9, n).astype(np.uint16), rng.integers(0, 8, n).astype(np.uint16)
    t, p = np.sort(rng.integers(0, 500_000, n)), rng.integers(0, 2, n).astype(np.uint8)
    first, last = new_surface(8, 9), new_surface(8, 9)
    update_sae(x, y, t, p, first, last, refractory)
    expected: dict[tuple[int, int, int], tuple[int, int]] = {}
    for i in range(n):
        key = (int(p[i]), int(y[i]), int(x[i]))
        first_ns, last_ns = expected.get(key, (NEVER, NEVER))
        expected[key] = (int(t[i]) if t[i] - last_ns >= refractory else first_ns, int(t[i]))
    for key, stamps in expected.items():
        assert (first[key], last[key]) == stamps


@pytest.mark.parametrize("memory_ns", [65_535, 65_536, 100 * MS, 1000 * MS])
def test_encoded_ages_are_exact_ceilings(memory_ns: int) -> None:
    rng = np.random.default_rng(2)
    t_end, unit = 2_000 * MS, age_unit_ns(memory_ns)
    age = np.concatenate(
        [rng.integers(1, 2 * memory_ns, 5000), [1, unit, unit + 1, memory_ns, memory_ns + 1], unit * np.arange(1, 99)]
    )
    stamp = np.append(t_end - age, [EMPTY, t_end, t_end + 5]).astype(np.int32)
    expected = np.where(age <= memory_ns, -(-age // unit), 0)
    assert np.array_equal(encode_ages(stamp, t_end, memory_ns), np.append(expected, [0, 0, 0]))
    assert expected.max() <= 65_535
    both = np.stack([stamp, rng.permutation(stamp)])[:, :, None]
    assert np.array_equal(encode_newest(both, t_end, memory_ns), encode_ages(both.max(axis=0), t_end, memory_ns))


def test_patches_hold_same_polarity_ages_in_row_order() -> None:
    surface = new_surface(8, 9)
    surface[1] = np.arange(72).reshape(8, 9)
    surface[1, 2, 3] = EMPTY
    age, patch, ring = np.empty(1, np.uint32), np.empty((1, 25), np.uint32), np.empty((1, 24), np.uint32)
    x, y, p = np.array([4], np.uint16), np.array([3], np.uint16), np.array([1], np.uint8)
    gather_patches(surface, x, y, p, 100, 85, age, patch, ring)
    expected = 100 - surface[1, 1:6, 2:7].astype(np.int64).ravel()
    expected[expected > 85] = 0
    assert np.array_equal(patch[0], expected)
    assert age[0] == patch[0, 12] == 100 - (3 * 9 + 4)
    assert (patch == 0).sum() >= 2
    around = np.ones((7, 7), bool)
    around[1:6, 1:6] = False
    expected = 100 - surface[1, 0:7, 1:8][around].astype(np.int64)
    expected[expected > 85] = 0
    assert np.array_equal(ring[0], expected)


def test_patches_may_come_without_a_ring_nearer_to_the_edge() -> None:
    surface = new_surface(8, 9)
    surface[1] = np.arange(72).reshape(8, 9)
    age, patch, ring = np.empty(1, np.uint32), np.empty((1, 25), np.uint32), np.empty((0, 24), np.uint32)
    corner = np.array([2], np.uint16)
    gather_patches(surface, corner, corner, np.array([1], np.uint8), 100, 200, age, patch, ring)
    assert np.array_equal(patch[0], 100 - surface[1, :5, :5].ravel())
