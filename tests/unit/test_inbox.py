"""The inbox between the network's threads and the main thread."""

from __future__ import annotations

import threading

from velod.runtime.inbox import Inbox


def filled(inbox: Inbox, *items: tuple[str, bytes]) -> list[bytes]:
    for source, data in items:
        inbox.put(source, "key", data)
    out = []
    while (item := inbox.get(0.0)) is not None:
        out.append(item.data)
    return out


def inbox_of(capacity: int) -> Inbox:
    inbox = Inbox()
    inbox.add_source("a", capacity)
    inbox.add_source("b", capacity)
    inbox.add_source("done", capacity, urgent=True)
    return inbox


def test_sources_are_served_in_the_order_of_arrival() -> None:
    assert filled(inbox_of(9), ("a", b"1"), ("b", b"2"), ("a", b"3")) == [b"1", b"2", b"3"]


def test_urgent_items_overtake() -> None:
    assert filled(inbox_of(9), ("a", b"1"), ("done", b"2"), ("b", b"3"), ("done", b"4")) == [b"2", b"4", b"1", b"3"]


def test_a_full_source_drops_its_own_oldest_and_counts_it() -> None:
    inbox = inbox_of(2)
    assert filled(inbox, ("a", b"1"), ("b", b"2"), ("a", b"3"), ("a", b"4")) == [b"3", b"2", b"4"]
    assert inbox.counters == {"inbox.overflow.a": 1}
    assert inbox.waiting() == 0


def test_get_wakes_when_something_comes() -> None:
    inbox = inbox_of(2)
    threading.Timer(0.05, inbox.put, ("a", "key", b"late")).start()
    item = inbox.get(5.0)
    assert item is not None
    assert (item.source, item.key, item.data) == ("a", "key", b"late")


def test_get_gives_up_after_its_timeout() -> None:
    assert inbox_of(2).get(0.01) is None


def test_a_source_holds_no_more_bytes_than_it_may() -> None:
    inbox = inbox_of(9)
    inbox.add_source("large", 9, max_bytes=10)
    items = [("large", b"1234"), ("b", b"x"), ("large", b"5678"), ("large", b"123456789"), ("large", b"y")]
    assert filled(inbox, *items) == [b"x", b"123456789", b"y"]
    assert inbox.counters == {"inbox.overflow.large": 2}
    assert filled(inbox, ("large", b"longer than it may be")) == [b"longer than it may be"]
