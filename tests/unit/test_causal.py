"""Selection event by event: against a plain twin, on an edge that is known, and without a look ahead."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from tests.moving_edges import HEIGHT, T0_NS, WIDTH, Events, edges
from velod.events.causal import all_open, enter_and_select, split_ages
from velod.events.plane_fit import NOISE_RMS2, fit_plane
from velod.events.sae import NEVER, update_sae
from velod.events.selection import GOOD, MAX_ASYMMETRY, SYMMETRY_NOISE
from velod.events.surface_clock import new_surface

MS = 1_000_000
EPOCH_NS = T0_NS - 7
MEMORY, REFRACTORY, CELL_PX, BORDER = 100 * MS, 10 * MS, 7, 5
RING = [(dy, dx) for dy in (-3, 0, 3) for dx in (-3, 0, 3) if (dy, dx) != (0, 0)]


@dataclass
class Selected:
    """(p, y, x) and the stamps of the neighbourhood of each selected event, in the order of their selection."""

    at: np.ndarray
    stamps: np.ndarray

    @property
    def completed_ns(self) -> np.ndarray:
        return self.stamps.max(axis=1)


def selected(events: Events, rest_ns: int = 0, capacity: int = 20_000, time_noise_s: float = 0.0) -> Selected:
    first, last, taken = (new_surface(HEIGHT, WIDTH) for _ in range(3))
    rows, columns = np.arange(HEIGHT) // CELL_PX, np.arange(WIDTH) // CELL_PX
    at, stamps = np.empty((capacity, 3), np.int32), np.empty((capacity, 49), np.int64)
    n = enter_and_select(
        events.x, events.y, events.t_ns, events.p, first, last, REFRACTORY, EPOCH_NS,
        taken, all_open(rows[-1] + 1, columns[-1] + 1), rows, columns, rest_ns, BORDER,
        MEMORY, 1.0, 2, 20, 0.35, time_noise_s, at, stamps, 0,
    )  # fmt: skip
    same_first, same_last = new_surface(HEIGHT, WIDTH), new_surface(HEIGHT, WIDTH)
    update_sae(events.x, events.y, events.t_ns, events.p, same_first, same_last, REFRACTORY, EPOCH_NS)
    assert np.array_equal(first, same_first) and np.array_equal(last, same_last)
    return Selected(at[:n], stamps[:n])


def twin(events: Events, rest_ns: int, time_noise_s: float) -> Selected:
    """The rule as it reads, with dictionaries for the surfaces."""
    first: dict[tuple[int, int, int], int] = {}
    last: dict[tuple[int, int, int], int] = {}
    taken: dict[tuple[int, int, int], int] = {}
    opens: dict[tuple[int, int], int] = {}
    at, stamps = [], []
    for x, y, t, p in zip(*(c.tolist() for c in (events.x, events.y, events.t_ns, events.p)), strict=True):
        in_burst = t - last.get((p, y, x), NEVER) < REFRACTORY
        last[p, y, x] = t
        if in_burst:
            continue
        first[p, y, x] = t
        for dy, dx in RING:
            r, c = y - dy, x - dx
            cell = (r // CELL_PX, c // CELL_PX)
            if not (BORDER <= r < HEIGHT - BORDER and BORDER <= c < WIDTH - BORDER) or t < opens.get(cell, NEVER):
                continue
            middle = first.get((p, r, c), NEVER)
            ring = {(i, j): min(t - first.get((p, r + i, c + j), NEVER), MEMORY) for i, j in RING}
            if t - middle > MEMORY // 2 or taken.get((p, r, c)) == middle:
                continue
            offset = {d: a - (t - middle) for d, a in ring.items()}
            halves = [(offset[d], offset[-d[0], -d[1]]) for d in RING[:4]]
            slack_ns = SYMMETRY_NOISE * time_noise_s * 1e9
            if sum(abs(a + b) for a, b in halves) > MAX_ASYMMETRY * sum(abs(a - b) for a, b in halves) + slack_ns:
                continue
            patch = [first.get((p, r + i, c + j), NEVER) for i in range(-2, 3) for j in range(-2, 3)]
            age = np.array([(t + 1 - s) * 1e-9 if t + 1 - s <= MEMORY else 0.0 for s in patch])
            n, gx, gy, _, rms, *_ = fit_plane(age, 1.0, 2, 20, time_noise_s)
            gate = 0.35 if t >= opens.get(cell, NEVER) + rest_ns else GOOD * 0.35
            if n and math.sqrt(max(rms**2 - NOISE_RMS2 * time_noise_s**2, 0.0)) < gate * math.hypot(gx, gy):
                at.append((p, r, c))
                stamps.append([first.get((p, r + i, c + j), NEVER) for i in range(-3, 4) for j in range(-3, 4)])
                taken[p, r, c], opens[cell] = middle, t + rest_ns
    return Selected(np.array(at).reshape(-1, 3), np.array(stamps, np.int64).reshape(-1, 49))


def noisy(jitter_ns: int, seed: int = 1, **how: Any) -> Events:
    """Edges whose events come up to ``jitter_ns`` late, and one event in ten not at all."""
    e = edges(**how)
    rng = np.random.default_rng(seed)
    e = e[rng.random(len(e.x)) > 0.1]
    e.t_ns = e.t_ns + rng.integers(0, jitter_ns + 1, len(e.t_ns))
    return e[np.argsort(e.t_ns, kind="stable")]


def test_the_kernel_selects_what_its_plain_twin_does() -> None:
    for angle in (0.0, 0.9, 2.5, -1.2):
        events = noisy(jitter_ns=300_000, angle=angle, seconds=0.06)
        for rest_ns, time_noise_s in ((0, 0.0), (5 * MS, 0.0), (5 * MS, 1e-4)):
            ours = selected(events, rest_ns, time_noise_s=time_noise_s)
            plain = twin(events, rest_ns, time_noise_s)
            assert len(ours.at) > 50
            assert np.array_equal(ours.at, plain.at) and np.array_equal(ours.stamps, plain.stamps)


def test_an_event_is_selected_by_the_one_that_completes_its_neighbourhood() -> None:
    # A vertical edge, one column every 2 ms: column x is complete when column x + 3 has fired.
    events = edges(speed=500.0, spacing_px=1000.0, seconds=0.1)
    s = selected(events)
    assert np.array_equal(s.completed_ns - s.stamps[:, 24], np.full(len(s.at), 6 * MS))
    assert set(map(tuple, s.at[:, 1:].tolist())) == {
        (y, x) for y in range(BORDER, HEIGHT - BORDER) for x in range(BORDER, 47)
    }


def test_an_edge_is_selected_whichever_way_it_moves() -> None:
    for angle in np.linspace(-math.pi, math.pi, 13):
        pixels = {tuple(row) for row in selected(edges(angle=angle, seconds=0.08)).at.tolist()}
        inside = (HEIGHT - 2 * BORDER) * (WIDTH - 2 * BORDER)
        assert len(pixels) > 0.5 * inside, angle


@examples(max_examples=20)
@given(st.integers(0, 10**6), st.sampled_from([0, 3 * MS]))
def test_what_comes_later_changes_nothing(cut: int, rest_ns: int) -> None:
    events = noisy(jitter_ns=200_000, angle=0.7, seconds=0.05)
    cut %= len(events.x)
    whole, head = selected(events, rest_ns), selected(events[:cut], rest_ns)
    assert np.array_equal(head.at, whole.at[: len(head.at)])
    assert np.array_equal(head.stamps, whole.stamps[: len(head.at)])
    assert (whole.completed_ns[len(head.at) :] >= events.t_ns[cut]).all()


def test_a_cell_rests_after_it_has_given_an_event() -> None:
    events = noisy(jitter_ns=200_000, angle=0.4, seconds=0.1)
    s = selected(events, rest_ns=8 * MS)
    cells: dict[tuple[int, int], list[int]] = {}
    for (_, y, x), t in zip(s.at.tolist(), s.completed_ns.tolist(), strict=True):
        cells.setdefault((y // CELL_PX, x // CELL_PX), []).append(t)
    assert min(np.diff(t).min() for t in cells.values() if len(t) > 1) >= 8 * MS
    assert 100 < len(s.at) < len(selected(events).at) / 4


def test_a_full_buffer_takes_no_more() -> None:
    events = edges()
    assert np.array_equal(selected(events, capacity=7).at, selected(events).at[:7])


def test_ages_are_counted_from_the_end_end_with_the_memory_and_are_split_into_middle_and_ring() -> None:
    rng = np.random.default_rng(3)
    stamps = T0_NS - rng.integers(0, 2 * MEMORY, (5, 7, 7))
    stamps[0, 0, :4] = T0_NS, T0_NS - MEMORY + 5, T0_NS - MEMORY, NEVER
    ages = np.where(T0_NS + 5 - stamps <= MEMORY, T0_NS + 5 - stamps, 0)
    assert ages[0, 0, :4].tolist() == [5, MEMORY, 0, 0]
    age, patch, ring = np.empty(5, np.uint32), np.empty((5, 25), np.uint32), np.empty((5, 24), np.uint32)
    split_ages(stamps.reshape(5, 49), T0_NS + 5, MEMORY, age, patch, ring)
    inner = np.zeros((7, 7), bool)
    inner[1:6, 1:6] = True
    assert np.array_equal(age, ages[:, 3, 3])
    assert np.array_equal(patch, ages[:, inner])
    assert np.array_equal(ring, ages[:, ~inner])
