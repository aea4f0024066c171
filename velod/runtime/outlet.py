"""Publishing: one declared publisher per key, with the quality of service of its topic."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any, Self

import zenoh

from velod.types import Message
from velod.wire import encode
from velod.wire.topics import Topic, key

_PRIORITY = {
    "real_time": zenoh.Priority.REAL_TIME,
    "interactive_high": zenoh.Priority.INTERACTIVE_HIGH,
    "interactive_low": zenoh.Priority.INTERACTIVE_LOW,
    "data_high": zenoh.Priority.DATA_HIGH,
    "data": zenoh.Priority.DATA,
    "data_low": zenoh.Priority.DATA_LOW,
    "background": zenoh.Priority.BACKGROUND,
}


class Outlet:
    """What a process publishes on the topics of one rig. A context manager.

    Streams drop where a receiver cannot follow. ``lossless`` blocks instead: for replay only, because one stopped
    receiver then stops the publisher.
    """

    def __init__(self, session: zenoh.Session, rig: str, lossless: bool = False, author: str = "") -> None:
        """``author``: travels beside each message, for those who publish on the same key to tell them apart."""
        self.counters: dict[str, int] = {}
        self._session, self._rig = session, rig
        self._author = author.encode() or None
        self._congestion = zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
        self._publishers: dict[tuple[str, tuple[tuple[str, str], ...]], Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for publisher in self._publishers.values():
            publisher.undeclare()
        self._publishers.clear()

    def publish(self, topic: Topic, message: Message, t_origin_ns: int = 0, **parts: str) -> int:
        """Encode and publish; returns ``t_pub_ns``. Raises ValueError for a message that cannot be encoded."""
        t_pub_ns = time.time_ns()
        self.publish_bytes(topic, encode(message, t_pub_ns, t_origin_ns), **parts)
        return t_pub_ns

    def publish_bytes(self, topic: Topic, data: bytes, **parts: str) -> None:
        """Publish what has been encoded already."""
        self.publisher(topic, **parts).put(data, attachment=self._author)
        for name, n in ((f"out.{topic.name}", 1), (f"bytes.{topic.name}", len(data))):
            self.counters[name] = self.counters.get(name, 0) + n

    def publisher(self, topic: Topic, **parts: str) -> Any:
        """The publisher of one key, declared on first use."""
        found = self._publishers.get(at := (topic.name, tuple(parts.items())))
        if found is None:
            found = self._publishers[at] = self._session.declare_publisher(
                key(topic, self._rig, **parts),
                congestion_control=self._congestion,
                priority=_PRIORITY[topic.qos.priority],
            )
        return found

    def wait_for_subscriber(self, topic: Topic, timeout_s: float, **parts: str) -> bool:
        """Wait until somebody listens; False after ``timeout_s``."""
        publisher = self.publisher(topic, **parts)
        deadline_s = time.monotonic() + timeout_s
        while not publisher.matching_status.matching:
            if time.monotonic() > deadline_s:
                return False
            time.sleep(0.01)
        return True
