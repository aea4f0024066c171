"""Read packets ahead of time, so that the disk and the decompressor do not make a player late."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable, Iterator

from velod.types import EventPacket, ImuPacket

LIMIT_BYTES = 1 << 30
_BYTES_PER_EVENT = 13

Packet = EventPacket | ImuPacket


class Prefetch:
    """An iterator over packets that a thread reads ahead, up to ``limit_bytes`` of them in memory."""

    def __init__(self, packets: Iterable[Packet], limit_bytes: int = LIMIT_BYTES) -> None:
        self._limit_bytes = limit_bytes
        self._read: deque[Packet] = deque()
        self._held_bytes = 0
        self._ended = False
        self._error: Exception | None = None
        self._changed = threading.Condition()
        # A daemon: a player that is stopped early does not wait for the rest of the file.
        threading.Thread(target=self._read_all, args=(packets,), daemon=True).start()

    def fill(self, timeout_s: float) -> None:
        """Wait until all is read, or as much as may be held, or ``timeout_s`` is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or self._held_bytes >= self._limit_bytes, timeout_s)

    def __iter__(self) -> Iterator[Packet]:
        """Packets in order. Raises, in its place, what reading raised."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or bool(self._read))
                if not self._read:
                    if self._error is not None:
                        raise self._error
                    return
                packet = self._read.popleft()
                self._held_bytes -= _size(packet)
                self._changed.notify_all()
            yield packet

    def _read_all(self, packets: Iterable[Packet]) -> None:
        try:
            for packet in packets:
                with self._changed:
                    self._changed.wait_for(lambda: self._held_bytes < self._limit_bytes)
                    self._read.append(packet)
                    self._held_bytes += _size(packet)
                    self._changed.notify_all()
        except Exception as e:  # raised again where the packets are taken
            self._error = e
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()


def _size(packet: Packet) -> int:
    return _BYTES_PER_EVENT * len(packet.x) if isinstance(packet, EventPacket) else packet.accel.nbytes * 3
