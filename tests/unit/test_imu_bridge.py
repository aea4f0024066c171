"""The IMU straight from the sensor while ingest is silent: each sample once, in order, whichever way it came."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from velod.config import IngestSettings
from velod.runtime import imu_bridge
from velod.runtime.imu_bridge import AGAIN_NS, KEPT, SILENT_S, ImuBridge
from velod.types import ImuPacket, ImuSamples
from velod.wire import decode, encode

STEP_NS = 5_000_000
START_NS = 1_000_000_000_000
OFFSET_S = 0.002
"""The IMU's clock is ahead of the camera's."""


def packet(i: int, start_ns: int = START_NS) -> ImuPacket:
    """Sample number ``i``, of no other value than any other."""
    t_ns = start_ns + i * STEP_NS
    return ImuPacket(i, t_ns, np.array([t_ns]), np.full((1, 3), float(i)), np.full((1, 3), -float(i)))


def from_ingest(i: int, event_t_ns: int = START_NS, start_ns: int = START_NS) -> ImuSamples:
    """What ingest makes of that packet."""
    p = packet(i, start_ns)
    t_ns = p.sample_t_ns - round(OFFSET_S * 1e9)
    return ImuSamples(i, int(t_ns[-1]), event_t_ns, 7, event_t_ns, t_ns, p.accel, p.gyro)


def bridge() -> ImuBridge:
    return ImuBridge(IngestSettings(), OFFSET_S)


def values(handed: list[ImuSamples]) -> list[float]:
    return [float(a) for samples in handed for a in samples.accel[:, 0]]


@pytest.mark.parametrize("seed", range(20))
def test_every_sample_is_handed_over_once_and_in_order_whatever_ingest_does(seed: int) -> None:
    """Ingest falls silent and comes back at random, late by up to four samples, or with what was bridged already."""
    rng, b = np.random.default_rng(seed), bridge()
    handed: list[ImuSamples] = []
    waiting: list[int] = []  # in ingest
    silent_until = first = 0  # the first one that this ingest has heard
    for i in range(400):
        now_s = i * STEP_NS * 1e-9
        b.keep(encode(packet(i), 0))
        waiting.append(i)
        if i > 10 and rng.random() < 0.02:
            silent_until = i + int(rng.integers(5, 60))
            if rng.random() < 0.5:
                waiting.clear()  # it died with them
                first = i + 1
        if i >= silent_until and rng.random() < 0.7:
            for k in waiting:
                handed += b.from_ingest(replace(from_ingest(k), seq=k - first), now_s)
            waiting.clear()
        handed += b.due(now_s)
    handed += b.due(1e9)
    assert values(handed) == [float(i) for i in range(400)]
    t_ns = np.concatenate([samples.sample_t_ns for samples in handed])
    assert np.array_equal(t_ns, START_NS - round(OFFSET_S * 1e9) + STEP_NS * np.arange(400))
    assert b.counters["bridge.begun"] > 0


def test_a_silence_of_ingest_costs_no_look_at_all_that_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at = []
    monkeypatch.setattr(imu_bridge, "decode", lambda data, kind: looked_at.append(data) or decode(data, kind))
    b, n = bridge(), KEPT + 100
    for i in range(n):
        b.keep(encode(packet(i), 0))
        b.from_ingest(from_ingest(i), i * STEP_NS * 1e-9)
    assert not looked_at
    b.keep(encode(packet(n), 0))
    assert values(b.due(1e9)) == [float(n)]
    assert len(looked_at) <= AGAIN_NS // STEP_NS + 2


def test_ingest_is_waited_for_a_moment_and_its_last_word_on_the_events_stands() -> None:
    b = bridge()
    b.keep(encode(packet(0), 0))
    b.from_ingest(from_ingest(0, event_t_ns=START_NS + 1), 0.0)
    b.keep(encode(packet(1), 0))
    assert b.due(0.9 * SILENT_S) == []
    (samples,) = b.due(1.1 * SILENT_S)
    assert (samples.event_t_ns, samples.batch_seq, samples.t_ns) == (START_NS + 1, 7, samples.sample_t_ns[-1])
    assert values([samples]) == [1.0]


def test_the_end_of_a_recording_is_no_bridge() -> None:
    b = bridge()
    b.keep(encode(packet(0), 0))
    b.from_ingest(from_ingest(0), 0.0)
    assert b.due(100.0) == []
    assert not b.counters


def test_what_ingest_says_of_events_alone_does_not_hide_that_its_samples_are_missing() -> None:
    b = bridge()
    b.from_ingest(from_ingest(0), 0.0)
    none = ImuSamples(1, START_NS, START_NS + 9, 8, START_NS + 9, np.empty(0, np.int64), *np.empty((2, 0, 3)))
    assert b.from_ingest(none, 2.0 * SILENT_S) == [none]
    b.keep(encode(packet(1), 0))
    (samples,) = b.due(2.0 * SILENT_S)
    assert samples.batch_seq == 8


def test_nothing_is_bridged_before_ingest_was_heard_of() -> None:
    b = bridge()
    b.keep(encode(packet(0), 0))
    assert b.due(100.0) == []


def test_a_sensor_s_clock_that_is_set_anew_begins_anew() -> None:
    b = bridge()
    b.from_ingest(from_ingest(3), 0.0)
    anew = from_ingest(0, event_t_ns=0, start_ns=STEP_NS)
    assert values(b.from_ingest(anew, 0.01)) == [0.0]


def test_a_damaged_packet_is_counted_as_the_bridge_s_where_it_was_read_and_the_others_are_used() -> None:
    """An ingest that lives counts it too: under the same name it would stand twice in the health of a rig."""
    b = bridge()
    b.keep(b"\xff")
    b.from_ingest(from_ingest(0), 0.0)
    assert not b.counters
    b.keep(encode(packet(1), 0))
    assert values(b.due(1.0)) == [1.0]
    refused = {name: n for name, n in b.counters.items() if "wire" in name}
    assert sum(refused.values()) == 1 and all(name.startswith("bridge.wire.") for name in refused)
