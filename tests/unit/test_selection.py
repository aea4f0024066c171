"""Which events are selected: completed neighbourhoods, once each, spread over the image; or the paper's rules."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.moving_edges import HEIGHT, T0_NS, WIDTH, Events, edges
from velod.events.plane_fit import NOISE_RMS2, fit_plane
from velod.events.sae import encode_ages, update_sae
from velod.events.selection import MAX_ASYMMETRY, SYMMETRY_NOISE, select_burst, select_paper
from velod.events.surface_clock import EMPTY, new_surface

MS = 1_000_000
MEMORY = 100 * MS
RULES: dict[str, Any] = {
    "memory_ns": MEMORY,
    "reject_px": 1.0,
    "rejections": 2,
    "min_neighbours": 20,
    "max_rms_px": 0.35,
    "border_px": 5,
    "quota": 50,
    "seq": 3,
}


def surfaces(events: Events) -> tuple[np.ndarray, np.ndarray]:
    first, last = new_surface(HEIGHT, WIDTH), new_surface(HEIGHT, WIDTH)
    update_sae(events.x, events.y, events.t_ns, events.p, first, last, 10 * MS)
    return first, last


def burst(
    first: np.ndarray, t_start: int, t_end: int, taken: np.ndarray | None = None, **rules: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if taken is None:
        taken = new_surface(HEIGHT, WIDTH)
    encoded = encode_ages(first, t_end, MEMORY)
    return select_burst(first, taken, encoded, t_start, t_end, **{**RULES, **rules})


def one_edge(t_ms: float, speed: float = 500.0) -> tuple[np.ndarray, int]:
    """The surface of one vertical edge from the left, and the time at which it has been cut."""
    events = edges(speed=speed, spacing_px=1000.0, seconds=0.2)
    t_end = T0_NS + int(t_ms * MS)
    return surfaces(events[events.t_ns < t_end])[0], t_end


def test_events_are_selected_once_the_edge_has_passed_their_neighbourhood() -> None:
    first, t_end = one_edge(60.1)  # the edge is at column 30
    taken = new_surface(HEIGHT, WIDTH)
    burst(first, t_end - 20 * MS, t_end - 10 * MS, taken, quota=500)
    x, y, p = burst(first, t_end - 10 * MS, t_end, taken, quota=500)
    # The columns three behind those that the edge has crossed in these 10 ms.
    assert set(x) == {23, 24, 25, 26, 27}
    assert set(y) == set(range(5, HEIGHT - 5))
    assert (p == 0).all()


def test_neighbourhoods_completed_in_an_earlier_batch_are_left_alone() -> None:
    first, t_end = one_edge(60.1)
    x, _, _ = burst(first, t_end - 2 * MS, t_end, quota=100)
    assert x.min() > 25


def test_what_the_quota_leaves_room_for_are_events_with_a_narrow_neighbourhood_passed_before() -> None:
    first, t_end = one_edge(60.1)
    first[:, 17:] = first[:, :10] = EMPTY  # a strip of the edge, too short for a 7x7 about most of its rows
    _, y, _ = burst(first, t_end - 4 * MS, t_end, quota=500)
    assert set(y) == {12, 13, 14}  # the columns passed in these 4 ms: rows 13 = middle of 7


def test_edges_too_slow_for_a_wide_neighbourhood_are_selected_by_their_narrow_one_at_once() -> None:
    # 80 px/s: two columns in 25 ms, three in 37.5 ms, of which half the memory leaves 50 ms less the batch's 20.
    first, t_end = one_edge(150.1, speed=80.0)  # the edge is at column 12
    taken = new_surface(HEIGHT, WIDTH)
    x, _, _ = burst(first, t_end - 20 * MS, t_end, taken, quota=500)
    assert set(x) == {9, 10}
    x, _, _ = burst(one_edge(170.1, speed=80.0)[0], t_end, t_end + 20 * MS, taken, quota=500)
    assert set(x) == {11}


def test_an_event_is_selected_once() -> None:
    first, t_end = one_edge(60.1)
    taken = new_surface(HEIGHT, WIDTH)
    before = burst(first, t_end - 10 * MS, t_end, taken, quota=60)
    after = burst(first, t_end - 10 * MS, t_end, taken, quota=500)
    pixels = [set(zip(x.tolist(), y.tolist(), strict=True)) for x, y, _ in (before, after)]
    assert len(pixels[0]) == 60
    assert not pixels[0] & pixels[1]


def test_selection_keeps_the_quota_and_the_border() -> None:
    first, _ = surfaces(edges(angle=0.6))
    x, y, _ = burst(first, T0_NS + 50 * MS, T0_NS + 100 * MS, border_px=8)
    assert len(x) == 50
    assert x.min() >= 8 and x.max() < WIDTH - 8 and y.min() >= 8 and y.max() < HEIGHT - 8


def test_selection_is_spread_over_the_image() -> None:
    first, _ = surfaces(edges(angle=0.6))
    x, y, _ = burst(first, T0_NS + 50 * MS, T0_NS + 100 * MS)
    quarters = np.bincount((x >= WIDTH // 2) * 2 + (y >= HEIGHT // 2), minlength=4)
    assert quarters.min() >= 6


def test_selection_depends_on_seq_and_on_nothing_hidden() -> None:
    first, _ = surfaces(edges(angle=0.6))
    span = (T0_NS + 50 * MS, T0_NS + 100 * MS)
    a, b, other = burst(first, *span), burst(first, *span), burst(first, *span, seq=4)
    assert all(np.array_equal(i, j) for i, j in zip(a, b, strict=True))
    assert not np.array_equal(a[0], other[0])


def test_noise_is_not_selected() -> None:
    rng = np.random.default_rng(5)
    first = new_surface(HEIGHT, WIDTH)
    first[:] = T0_NS + rng.integers(0, 50 * MS, first.shape)
    x, _, _ = burst(first, T0_NS, T0_NS + 50 * MS)
    assert len(x) == 0


def test_an_empty_surface_gives_nothing() -> None:
    x, y, p = burst(new_surface(HEIGHT, WIDTH), T0_NS, T0_NS + 10 * MS)
    assert (len(x), len(y), len(p)) == (0, 0, 0)
    assert (x.dtype, y.dtype, p.dtype) == (np.uint16, np.uint16, np.uint8)


def burst_twin(
    first: np.ndarray, t_end: int, completed_from: int, completed_to: int, reach: int, time_noise_s: float
) -> set[tuple[int, int, int]]:
    """The rule for bursts, pixel by pixel, on times that are not encoded, for neighbours ``reach`` px away."""
    oldest, kept = t_end - MEMORY, set()
    for p, y, x in np.argwhere((first >= t_end - MEMORY // 2) & (first < t_end)).tolist():
        if not (5 <= x < WIDTH - 5 and 5 <= y < HEIGHT - 5):
            continue
        patch = np.maximum(first[p, y - 2 : y + 3, x - 2 : x + 3].ravel(), oldest)
        outer = np.maximum(
            first[p, y - reach : y + reach + 1 : reach, x - reach : x + reach + 1 : reach].ravel(), oldest
        )
        pairs = [(outer[i] - outer[4], outer[8 - i] - outer[4]) for i in range(4)]
        symmetric, antisymmetric = sum(abs(a + b) for a, b in pairs), sum(abs(a - b) for a, b in pairs)
        completed = completed_from <= np.delete(outer, 4).max() < completed_to
        n, gx, gy, _, rms, *_ = fit_plane(np.where(patch > oldest, t_end - patch, 0) * 1e-9, 1.0, 2, 20, time_noise_s)
        is_plane = symmetric <= MAX_ASYMMETRY * antisymmetric + SYMMETRY_NOISE * time_noise_s * 1e9
        own2 = max(rms**2 - NOISE_RMS2 * time_noise_s**2, 0.0)
        if completed and is_plane and n and own2 < 0.35**2 * (gx**2 + gy**2):
            kept.add((x, y, p))
    return kept


@pytest.mark.parametrize("time_noise_s", [0.0, 3e-4])
@pytest.mark.parametrize("seed", range(3))
def test_with_room_for_all_selection_is_what_its_plain_twin_says(seed: int, time_noise_s: float) -> None:
    events = edges(speed=300.0, angle=0.6 + seed)
    rng = np.random.default_rng(seed)
    kept = events[rng.random(len(events.x)) < 0.9]
    first, _ = surfaces(kept)
    first += rng.integers(-MS, MS, first.shape)
    t_start, t_end = T0_NS + 70 * MS, T0_NS + 95 * MS
    first[first >= t_end] = EMPTY
    x, y, p = burst(first, t_start, t_end, quota=5000, time_noise_s=time_noise_s)
    got = set(zip(x.tolist(), y.tolist(), p.tolist(), strict=True))
    wide = burst_twin(first, t_end, t_start, t_end, 3, time_noise_s)
    twin = wide | burst_twin(first, t_end, 2 * t_start - t_end, t_start, 2, time_noise_s)
    # Encoding rounds times to 1.5 us: events within that of a limit may fall on its other side.
    assert len(got ^ twin) <= 0.01 * len(twin)
    assert len(wide) > 100 and len(twin - wide) > 5


def paper_twin(last: np.ndarray, t_start: int, t_end: int, share: float) -> set[tuple[int, int, int]]:
    kept = set()
    for p, y, x in np.argwhere((last >= t_start) & (last < t_end)).tolist():
        if not (5 <= x < WIDTH - 5 and 5 <= y < HEIGHT - 5):
            continue
        patch = np.delete(last[p, y - 2 : y + 3, x - 2 : x + 3].ravel(), 12)
        near = patch[(patch >= t_end - MEMORY) & (patch < t_end)]
        if len(near) > 15 and abs(last[p, y, x] - near.mean()) <= share * (t_end - t_start):
            kept.add((x, y, p))
    return kept


@pytest.mark.parametrize("share", [0.025, 0.125])
def test_the_papers_rules_agree_with_their_plain_twin(share: float) -> None:
    events = edges(speed=300.0, angle=0.6)
    rng = np.random.default_rng(7)
    _, last = surfaces(events[rng.random(len(events.x)) < 0.8])
    span = (T0_NS + 60 * MS, T0_NS + 100 * MS)
    x, y, p = select_paper(last, *span, memory_ns=MEMORY, time_share=share, border_px=5, quota=5000, seq=0)
    got = set(zip(x.tolist(), y.tolist(), p.tolist(), strict=True))
    assert got == paper_twin(last, *span, share)
    assert 50 < len(got) < (last >= span[0]).sum()
