"""Who of several optimizers publishes: in plain cases, and for any pattern of processes that stop and go on."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from velod.runtime.succession import PATIENCE_S, RELINK_S, SETTLE_S, Succession, Turn

TICK_NS = 13_333_333
TICK_S = TICK_NS * 1e-9


def seqs(turns: list[Turn[int]]) -> list[tuple[int, int]]:
    return [(turn.seq, turn.output) for turn in turns]


def follower(ticks: int) -> Succession[int]:
    """Optimizer-1 after so many ticks that optimizer-0 has published."""
    s: Succession[int] = Succession("optimizer-1")
    s.joined("optimizer-0")
    for k in range(ticks):
        assert s.offer(k, k, k * TICK_S) == []
        s.heard("optimizer-0", k, k, k * TICK_S + 0.001)
    return s


def test_alone_it_leads_at_once_and_holds_nothing_back() -> None:
    s: Succession[int] = Succession("optimizer-0")
    assert [seqs(s.offer(k, k, float(k))) for k in range(3)] == [[(0, 0)], [(1, 1)], [(2, 2)]]
    assert s.role == "leads"


def test_a_follower_takes_over_at_once_when_the_leader_s_token_is_gone() -> None:
    s = follower(3)
    assert s.role == "standby"
    assert s.offer(3, 3, 3 * TICK_S) == []
    first = s.left("optimizer-0", 3 * TICK_S + 0.005)
    assert seqs(first) == [(3, 3)]
    second = s.offer(4, 4, 4 * TICK_S)
    assert seqs(second) == [(4, 4)]
    assert [turn.follows for turn in first + second] == [True, False], "what the other sent last may not have arrived"


def test_a_follower_takes_over_from_a_leader_that_falls_silent() -> None:
    s = follower(3)
    published = [turn for k in range(3, 9) for turn in s.offer(k, k, k * TICK_S)]
    assert seqs(published) == [(k, k) for k in range(3, 9)]
    assert PATIENCE_S + TICK_S < 0.1


def test_the_second_in_line_waits_for_the_first() -> None:
    s: Succession[int] = Succession("optimizer-2")
    for other in ("optimizer-0", "optimizer-1"):
        s.joined(other)
    s.heard("optimizer-0", 0, 0, 0.0)
    s.offer(1, 1, 0.0)
    for ms in range(1, int(2e3 * PATIENCE_S) - 1):
        assert s.look(ms * 1e-3) == []
    assert seqs(s.look(2.0 * PATIENCE_S)) == [(1, 1)]


def test_a_leader_that_was_stopped_publishes_nothing_until_it_knows_better() -> None:
    s: Succession[int] = Succession("optimizer-0")
    s.joined("optimizer-1")
    for ms in range(80):
        s.look(ms * 1e-3)
        if ms == 0:
            s.offer(0, 0, 0.0)
    assert s.role == "leads"
    # Five seconds later: the tick that it was at must not come out, the other has long published it.
    assert s.offer(1, 1, 5.08) == []
    assert s.counters["succession.slept"] == 1
    assert s.left("optimizer-1", 5.081) == []  # the link was given up, not the other
    s.heard("optimizer-1", 300, 300, 5.2)
    assert s.offer(2, 2, 5.201) == []
    assert s.look(5.202) == []
    assert s.role == "standby"


def test_without_word_of_another_a_leader_that_was_stopped_leads_again() -> None:
    s: Succession[int] = Succession("optimizer-0")
    s.joined("optimizer-1")
    for ms in range(80):
        s.offer(ms, ms, ms * 1e-3)
    assert s.offer(100, 100, 5.0) == []
    out = [turn for ms in range(int(1e3 * RELINK_S) + 100) for turn in s.look(5.0 + ms * 1e-3)]
    assert seqs(out) == [(80, 100)]


def test_of_two_leaders_the_one_that_is_behind_steps_back() -> None:
    a, b = Succession[int]("optimizer-0"), Succession[int]("optimizer-1")
    a.offer(5, 5, 0.0)
    b.offer(6, 6, 0.0)
    b.heard("optimizer-0", 5, 0, 0.001)
    a.heard("optimizer-1", 6, 0, 0.001)
    assert (a.role, b.role) == ("standby", "leads")


def test_of_two_leaders_at_the_same_tick_the_first_name_stays() -> None:
    a, b = Succession[int]("optimizer-0"), Succession[int]("optimizer-1")
    a.offer(5, 5, 0.0)
    b.offer(5, 5, 0.0)
    b.heard("optimizer-0", 5, 0, 0.001)
    a.heard("optimizer-1", 5, 0, 0.001)
    assert (a.role, b.role) == ("leads", "standby")


def test_after_the_sensor_s_clock_was_set_back_what_is_held_is_of_the_new_time() -> None:
    s = follower(3)
    s.offer(3, 3, 3 * TICK_S)
    s.offer(-1000, -1000, 4 * TICK_S)
    assert seqs(s.left("optimizer-0", 4 * TICK_S)) == [(3, -1000)]


@dataclass
class Process:
    """One optimizer: stopped for some spans of time, and what it hears arrives 1 ms late, or when it goes on."""

    succession: Succession[int]
    stops: list[tuple[int, int]]
    inbox: list[tuple[str, int, int]] = field(default_factory=list)
    made: int = 0

    def runs(self, ms: int) -> bool:
        return not any(start <= ms < end for start, end in self.stops)

    def step(self, ms: int) -> list[Turn[int]]:
        """What it publishes at this millisecond."""
        if not self.runs(ms):
            return []
        now_s = ms * 1e-3
        out = self.succession.look(now_s)
        for author, t_ns, seq in self.inbox:
            self.succession.heard(author, t_ns, seq, now_s)
        self.inbox.clear()
        while self.made * 13 <= ms:
            out += self.succession.offer(self.made, self.made, now_s)
            self.made += 1
        return out


SPANS = st.lists(st.tuples(st.integers(200, 1500), st.integers(1, 900)), max_size=2)


@given(SPANS, st.integers(0, 1))
def test_whatever_one_of_two_does_the_other_makes_it_one_stream(spans: list[tuple[int, int]], victim: int) -> None:
    names = ("optimizer-0", "optimizer-1")
    stops = [(start, start + length) for start, length in spans]
    processes = {n: Process(Succession(n), stops if i == victim else []) for i, n in enumerate(names)}
    for process in processes.values():
        for other in names:
            process.succession.joined(other)
    stream: list[tuple[int, int, int]] = []  # when, seq, tick
    for ms in range(3000):
        published = {name: process.step(ms) for name, process in processes.items()}
        for author, turns in published.items():
            for turn in turns:
                stream.append((ms, turn.seq, turn.output))
                for name, process in processes.items():
                    if name != author:
                        process.inbox.append((author, turn.output, turn.seq))
    at_ms, numbers, ticks = zip(*stream, strict=True)
    assert list(ticks) == list(range(len(ticks)))
    assert list(numbers) == list(range(len(ticks)))
    assert max(b - a for a, b in pairwise(at_ms)) <= 100


def test_a_leader_that_dozed_off_goes_on_once_it_has_listened() -> None:
    s: Succession[int] = Succession("optimizer-0")
    s.joined("optimizer-1")
    for ms in range(80):
        s.offer(ms, ms, ms * 1e-3)
    assert s.offer(80, 80, 0.120) == []
    assert s.look(0.120 + 0.5 * SETTLE_S) == []
    assert seqs(s.look(0.120 + SETTLE_S)) == [(80, 80)]
