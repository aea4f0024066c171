"""The dispatcher under any order of joins, deaths, batches and answers."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from velod.runtime.dispatch import Assignment, Dispatcher

WORKERS = ("a", "b", "c")
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("submit"), st.just("")),
        st.tuples(st.just("join"), st.sampled_from(WORKERS)),
        st.tuples(st.just("leave"), st.sampled_from(WORKERS)),
        st.tuples(st.just("done"), st.sampled_from(WORKERS)),
    ),
    max_size=80,
)


class Fleet:
    """A world of workers that hold what they were sent, and lose it when they die."""

    def __init__(self, window: int, capacity: int | None) -> None:
        self.dispatcher: Dispatcher[str] = Dispatcher(window, capacity)
        self.window = window
        self.held: dict[str, list[int]] = {}
        self.finished: list[int] = []
        self.submitted = 0

    def deliver(self, assignments: list[Assignment[str]]) -> None:
        for a in assignments:
            assert a.worker in self.held, "sent to a worker that is not there"
            assert a.batch == f"batch {a.seq}"
            fewest = min(len(h) for h in self.held.values())
            assert len(self.held[a.worker]) == fewest, "not the least outstanding"
            assert a.worker == min(w for w, h in self.held.items() if len(h) == fewest), "tie not to the lowest name"
            self.held[a.worker].append(a.seq)
            assert len(self.held[a.worker]) <= self.window

    def step(self, action: str, worker: str) -> None:
        d = self.dispatcher
        if action == "submit":
            self.submitted += 1
            self.deliver(d.submit(self.submitted, f"batch {self.submitted}", 0.0))
        elif action == "join":
            self.held[worker] = []
            self.deliver(d.join(worker, 0.0))
        elif action == "leave":
            self.held.pop(worker, None)
            self.deliver(d.leave(worker, 0.0))
        elif self.held.get(worker):
            seq = self.held[worker].pop(0)
            self.finished.append(seq)
            self.deliver(d.done(worker, seq, 0.0))

    def drain(self) -> None:
        self.step("join", "z")
        while any(self.held.values()):
            self.step("done", next(w for w, h in self.held.items() if h))


@given(steps=STEPS, window=st.integers(1, 3))
def test_whoever_dies_no_batch_is_lost_and_none_is_finished_twice(steps: list[tuple[str, str]], window: int) -> None:
    fleet = Fleet(window, capacity=None)
    for action, worker in steps:
        fleet.step(action, worker)
    fleet.drain()
    assert sorted(fleet.finished) == list(range(1, fleet.submitted + 1))


@given(steps=STEPS, window=st.integers(1, 3), capacity=st.integers(1, 4))
def test_a_bounded_queue_loses_exactly_what_it_counts(
    steps: list[tuple[str, str]], window: int, capacity: int
) -> None:
    fleet = Fleet(window, capacity)
    for action, worker in steps:
        fleet.step(action, worker)
        if action == "submit":
            assert len(fleet.dispatcher.waiting) <= capacity
    fleet.drain()
    lost = fleet.dispatcher.counters.get("dispatch.overflow", 0)
    assert len(set(fleet.finished)) == len(fleet.finished) == fleet.submitted - lost


@given(n=st.integers(0, 30), seed_worker=st.sampled_from(WORKERS))
def test_batches_of_one_worker_stay_in_order(n: int, seed_worker: str) -> None:
    fleet = Fleet(window=2, capacity=None)
    fleet.step("join", seed_worker)
    for _ in range(n):
        fleet.step("submit", "")
    while any(fleet.held.values()):
        fleet.step("done", seed_worker)
    assert fleet.finished == list(range(1, n + 1))
