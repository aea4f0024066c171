"""The dispatcher: who gets what, in plain cases."""

from __future__ import annotations

import pytest

from velod.runtime.dispatch import Assignment, Dispatcher


def sent(assignments: list[Assignment[str]]) -> list[tuple[str, int]]:
    return [(a.worker, a.seq) for a in assignments]


def test_batches_wait_until_a_worker_is_there() -> None:
    d: Dispatcher[str] = Dispatcher(window=2)
    assert d.submit(0, "x", 0.0) == []
    assert d.submit(1, "y", 0.0) == []
    assert sent(d.join("flow-0", 0.0)) == [("flow-0", 0), ("flow-0", 1)]


def test_two_workers_share_the_batches() -> None:
    d: Dispatcher[str] = Dispatcher(window=2)
    d.join("flow-1", 0.0)
    d.join("flow-0", 0.0)
    assert [sent(d.submit(i, "", 0.0)) for i in range(4)] == [
        [("flow-0", 0)],
        [("flow-1", 1)],
        [("flow-0", 2)],
        [("flow-1", 3)],
    ]


def test_a_killed_worker_s_batches_go_to_the_other_oldest_first() -> None:
    d: Dispatcher[str] = Dispatcher(window=4)
    d.join("flow-0", 0.0)
    for i in range(3):
        d.submit(i, "", 0.0)
    d.join("flow-1", 0.0)
    assert sent(d.leave("flow-0", 0.0)) == [("flow-1", 0), ("flow-1", 1), ("flow-1", 2)]
    assert d.counters == {"dispatch.resent": 3}


def test_a_worker_that_restarts_under_its_name_is_sent_its_batches_again() -> None:
    d: Dispatcher[str] = Dispatcher(window=2)
    d.join("flow-0", 0.0)
    d.submit(7, "", 0.0)
    assert sent(d.join("flow-0", 0.0)) == [("flow-0", 7)]


def test_the_oldest_waiting_batch_is_dropped_and_counted() -> None:
    d: Dispatcher[str] = Dispatcher(window=1, capacity=2)
    for i in range(5):
        d.submit(i, "", 0.0)
    assert d.waiting == (3, 4)
    assert d.counters == {"dispatch.overflow": 3}


def test_a_silent_worker_is_passed_over_until_it_finishes_something() -> None:
    d: Dispatcher[str] = Dispatcher(window=2, timeout_s=1.0)
    d.join("flow-0", 0.0)
    d.submit(0, "", 0.0)
    d.join("flow-1", 0.0)
    assert d.expire(0.9) == []
    assert sent(d.expire(1.1)) == [("flow-1", 0)]
    assert sent(d.submit(1, "", 1.2)) == [("flow-1", 1)]
    d.done("flow-0", 0, 1.3)
    assert sent(d.submit(2, "", 1.4)) == [("flow-0", 2)]
    assert d.counters == {"dispatch.expired": 1}


def test_a_worker_that_hangs_is_not_waited_for_where_another_could_take_over() -> None:
    d: Dispatcher[str] = Dispatcher(window=2, timeout_s=2.0, impatience_s=0.05)
    d.join("flow-0", 0.0)
    d.submit(0, "", 0.0)
    assert d.expire(1.0) == []
    d.join("flow-1", 1.0)
    assert sent(d.expire(1.0)) == [("flow-1", 0)]


def test_where_all_are_slow_nobody_is_taken_for_dead() -> None:
    d: Dispatcher[str] = Dispatcher(window=1, timeout_s=2.0, impatience_s=0.05)
    d.join("flow-0", 0.0)
    d.join("flow-1", 0.0)
    for i in range(100):
        d.submit(2 * i, "", 0.1 * i)
        d.submit(2 * i + 1, "", 0.1 * i)
        d.done("flow-0", 2 * i, 0.1 * i + 0.09)
        d.done("flow-1", 2 * i + 1, 0.1 * i + 0.09)
    d.submit(200, "", 10.0)
    assert d.expire(10.3) == []
    assert d.counters == {}


def test_the_only_worker_is_tried_again_after_a_lost_message() -> None:
    d: Dispatcher[str] = Dispatcher(window=1, timeout_s=1.0)
    d.join("flow-0", 0.0)
    d.submit(0, "", 0.0)
    assert sent(d.expire(1.5)) == [("flow-0", 0)]
    d.done("flow-0", 0, 1.6)
    assert d.workers == {"flow-0": ()}


@pytest.mark.parametrize(("window", "capacity", "timeout_s"), [(0, 1, 1.0), (1, 0, 1.0), (1, 1, 0.0)])
def test_nonsense_sizes_are_refused(window: int, capacity: int, timeout_s: float) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        Dispatcher(window, capacity, timeout_s)


def test_the_oldest_batch_without_an_answer_is_known_wherever_it_is() -> None:
    d: Dispatcher[str] = Dispatcher(window=1)
    assert d.unanswered_s(5.0) == 0.0
    d.submit(0, "0", 1.0)
    assert d.unanswered_s(1.5) == pytest.approx(0.5), "it waits for a worker"
    d.join("flow-0", 1.5)
    d.submit(1, "1", 2.0)
    assert d.unanswered_s(2.25) == pytest.approx(0.75), "since it was sent; the other waits for a shorter time"
    d.done("flow-0", 0, 2.5)
    assert d.unanswered_s(2.75) == pytest.approx(0.25)
    d.done("flow-0", 1, 3.0)
    assert d.unanswered_s(9.0) == 0.0


def test_a_new_batch_waits_for_the_queue_or_for_the_least_loaded_worker() -> None:
    d: Dispatcher[str] = Dispatcher(window=1)
    d.join("flow-0", 0.0)
    assert d.delay_s(1.0) == 0.0
    d.submit(0, "", 1.0)
    d.join("flow-1", 1.0)
    assert d.delay_s(1.5) == 0.0, "flow-1 has nothing to do"
    d.submit(1, "", 1.5)
    d.submit(2, "", 2.0)
    assert d.delay_s(2.3) == pytest.approx(0.3)
    d.done("flow-1", 1, 2.4)
    assert d.workers == {"flow-0": (0,), "flow-1": (2,)}
    d.done("flow-1", 2, 2.5)
    assert d.delay_s(2.5) == 0.0


def test_the_delay_of_a_worker_with_room_is_its_oldest_batch() -> None:
    d: Dispatcher[str] = Dispatcher(window=2)
    d.join("flow-0", 0.0)
    d.submit(0, "", 1.0)
    assert d.delay_s(1.25) == pytest.approx(0.25)


def test_old_batches_are_not_sent_but_counted() -> None:
    d: Dispatcher[str] = Dispatcher(window=3, max_wait_s=0.5)
    for i in range(3):
        d.submit(i, "", 0.1 * i)
    assert sent(d.join("flow-0", 0.65)) == [("flow-0", 2)]
    assert d.counters == {"dispatch.stale": 2}
