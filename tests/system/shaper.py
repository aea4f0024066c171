"""A poor link in user space: ``shaper.py NEAR FAR DELAY_MS LOSS MBIT`` carries frames between two tap devices.

For kernels without netem. Each direction: a frame waits for its turn at the rate, then for the delay; a share of them
is lost, by a seeded generator, and so is what would wait for longer than a queue of QUEUE_S holds. The kernel cuts
large segments and fills in checksums before it hands frames to a tap device, so TCP sees a real, lossy link.
"""

from __future__ import annotations

import fcntl
import os
import random
import select
import struct
import sys
import time
from collections import deque
from dataclasses import dataclass, field

QUEUE_S = 0.05
"""Of waiting frames, as in a switch; what comes on top is lost."""
_TUNSETIFF, _IFF_TAP, _IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
_LARGEST = 65_536
_AT_ONCE = 64


@dataclass(slots=True)
class Direction:
    """Frames on their way from ``source`` to ``sink`` (file descriptors)."""

    source: int
    sink: int
    delay_s: float
    loss: float
    byte_s: float  # time that one byte takes
    chance: random.Random
    waiting: deque[tuple[float, bytes]] = field(default_factory=deque)
    free_s: float = 0.0  # when the line is free again

    def take_in(self) -> None:
        """What has come, with the time at which it is due."""
        for _ in range(_AT_ONCE):
            try:
                frame = os.read(self.source, _LARGEST)
            except BlockingIOError:
                return
            start_s = max(self.free_s, now_s := time.monotonic())
            if start_s - now_s > QUEUE_S or self.chance.random() < self.loss:
                continue
            self.free_s = start_s + len(frame) * self.byte_s
            self.waiting.append((self.free_s + self.delay_s, frame))

    def let_out(self) -> None:
        """What is due."""
        while self.waiting and self.waiting[0][0] <= time.monotonic():
            os.write(self.sink, self.waiting.popleft()[1])


def open_tap(name: str) -> int:
    """A new tap device; it lives as long as the descriptor."""
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH", name.encode(), _IFF_TAP | _IFF_NO_PI))
    return device


def main() -> None:
    near, far = open_tap(sys.argv[1]), open_tap(sys.argv[2])
    delay_ms, loss, mbit = map(float, sys.argv[3:6])
    ways = [
        Direction(a, b, delay_ms * 1e-3, loss, 8e-6 / mbit, random.Random(seed))
        for seed, (a, b) in enumerate(((near, far), (far, near)))
    ]
    print("ready", flush=True)
    while True:
        due_s = min((way.waiting[0][0] for way in ways if way.waiting), default=time.monotonic() + 1.0)
        select.select([near, far], [], [], max(0.0, due_s - time.monotonic()))
        for way in ways:
            way.take_in()
            way.let_out()


if __name__ == "__main__":
    main()
