"""However the stream is cut, the same events come out, in order, under watermarks that hold."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from velod.io import Chunking, EventColumns, Imu
from velod.io.packets import packets, repeated
from velod.types import EventPacket, ImuPacket


class Source:
    """Events in memory, in blocks of seven."""

    name = "memory"

    def __init__(self, t_ns: list[int]) -> None:
        self.t_ns = np.sort(np.array(t_ns, dtype=np.int64))
        self.n_events = len(t_ns)
        self.first_t_ns, self.last_t_ns = int(self.t_ns[0]), int(self.t_ns[-1])

    def blocks(self) -> Iterator[EventColumns]:
        for start in range(0, self.n_events, 7):
            index = np.arange(start, min(start + 7, self.n_events))
            yield EventColumns(
                self.t_ns[index], index.astype(np.uint16), index.astype(np.uint16), (index % 2).astype(np.uint8)
            )


times = st.lists(st.integers(3_000_000, 60_000_000).map(lambda t: t - t % 100_000), min_size=1, max_size=60)
chunkings = st.one_of(
    st.sampled_from([60, 200, 1000]).map(lambda hz: Chunking.parse(f"{hz}hz")),
    st.integers(0, 1000).map(lambda seed: Chunking(seed=seed)),
)


def played(left: list[int], right: list[int], chunking: Chunking) -> list[EventPacket | ImuPacket]:
    t_ns = np.arange(2_000_000, 70_000_000, 5_000_000)
    imu = Imu(t_ns, np.zeros((len(t_ns), 3)), np.zeros((len(t_ns), 3)))
    return list(packets(Source(left), Source(right), imu, 2_000_000, int(t_ns[-1]), chunking))


@given(times, times, chunkings)
@settings(max_examples=60, deadline=None)
def test_every_event_comes_once_in_order_and_every_watermark_holds(
    left: list[int], right: list[int], chunking: Chunking
) -> None:
    stream = played(left, right, chunking)
    assert [p.t_ns for p in stream] == sorted(p.t_ns for p in stream)
    for camera, t_ns in (("left", left), ("right", right)):
        own = [p for p in stream if isinstance(p, EventPacket) and p.camera == camera]
        assert [p.seq for p in own] == list(range(len(own)))
        assert np.concatenate([p.event_t_ns for p in own]).tolist() == sorted(t_ns)
        assert np.concatenate([p.x for p in own]).tolist() == list(range(len(t_ns)))
        watermark = -1
        for packet in own:
            assert all(watermark <= t <= packet.t_ns for t in packet.event_t_ns)
            watermark = packet.t_ns
        assert len(own[-1].x) == 0
        assert own[-1].t_ns == 67_000_000 + 25_000_000
    samples = [p for p in stream if isinstance(p, ImuPacket)]
    assert np.concatenate([p.sample_t_ns for p in samples]).tolist() == list(range(2_000_000, 70_000_000, 5_000_000))


@given(times, chunkings)
@settings(max_examples=20, deadline=None)
def test_the_same_chunking_gives_the_same_packets(t_ns: list[int], chunking: Chunking) -> None:
    first, second = played(t_ns, t_ns, chunking), played(t_ns, t_ns, chunking)
    assert [(p.seq, p.t_ns) for p in first] == [(p.seq, p.t_ns) for p in second]


@pytest.mark.parametrize(
    ("text", "chunking"),
    [("200hz", Chunking(5_000_000)), ("60Hz", Chunking(16_666_666)), ("random:7", Chunking(seed=7))],
)
def test_a_chunking_is_read_from_text(text: str, chunking: Chunking) -> None:
    assert Chunking.parse(text) == chunking


@pytest.mark.parametrize("text", ["", "fast", "0hz", "-5hz", "random:x", "200hz:3"])
def test_nonsense_for_a_chunking_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected a rate"):
        Chunking.parse(text)


@given(times, times, chunkings)
def test_a_repeated_recording_is_one_stream_that_goes_on(
    left: list[int], right: list[int], chunking: Chunking
) -> None:
    t_ns = np.arange(2_000_000, 61_000_000, 5_000_000)
    imu = Imu(t_ns, np.zeros((len(t_ns), 3)), np.zeros((len(t_ns), 3)))
    once = list(packets(Source(left), Source(right), imu, int(t_ns[0]), 61_000_000, chunking))
    thrice = list(repeated(once, 3))
    for stream in ("left", "right", "imu"):
        part = [p for p in thrice if (p.camera if isinstance(p, EventPacket) else "imu") == stream]
        assert [p.seq for p in part] == list(range(len(part)))
        assert all(a.t_ns <= b.t_ns for a, b in itertools.pairwise(part))
        sent = [p.sample_t_ns if isinstance(p, ImuPacket) else p.event_t_ns for p in part]
        assert (np.diff(np.concatenate(sent)) >= 0).all()
        assert all(b[0] >= a.t_ns for a, b in zip(part, sent[1:], strict=False) if len(b)), "watermarks hold"
    assert sum(len(p.x) for p in thrice if isinstance(p, EventPacket)) == 3 * (len(left) + len(right))
