"""When a consumer should be told that all it gets is too old, and why that is."""

from __future__ import annotations

import math

import numpy as np


class StaleStream:
    """Watches one stream: whether everything of it has been discarded as stale for a while, and where its age arose.

    Without this a consumer whose clock is off by a second sees nothing at all, and does not learn why.
    """

    AFTER_NS = 1_000_000_000
    """So long must a stream be stale, ..."""
    AGAIN_NS = 60_000_000_000
    """... and so rarely is it said."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self._least_ms = np.full(3, math.inf)  # of each part of the age, while the stream is stale
        self._said_ns: int | None = None

    def fresh(self) -> None:
        """Something was not stale."""
        self._since_ns = None

    def stale(self, published_ms: float, way_ms: float, waited_ms: float, now_ns: int) -> str:
        """One message was: its age in ms when it was published, from then to its arrival, and in the queue.

        The first two are NaN where they are not known. Returns what is to be said now, mostly nothing.
        """
        if self._since_ns is None:
            self._since_ns = now_ns
            self._least_ms.fill(math.inf)
        self._least_ms = np.fmin(self._least_ms, (published_ms, way_ms, waited_ms))
        said = self._said_ns is not None and now_ns - self._said_ns < self.AGAIN_NS
        if said or now_ns - self._since_ns < self.AFTER_NS:
            return ""
        self._said_ns = now_ns
        return self._cause()

    def _cause(self) -> str:
        """The part that is the most of the age, in words."""
        known = np.where(np.isfinite(self._least_ms), self._least_ms, 0.0)
        seconds = f"{1e-3 * known.max():.3g} s"
        return (
            f"they are {seconds} old already when they are published",
            f"they arrive {seconds} after they were published: the publisher's clock is as far behind this host's, or"
            " the network is as slow",
            f"they wait here for {seconds}: receive() is called too rarely",
        )[int(known.argmax())]
