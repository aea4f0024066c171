"""Which samples of an IMU are good: the kernel against the rule in plain Python."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from velod.alarms import Alarms
from velod.config import from_tree
from velod.ingest.imu import ImuStream
from velod.ingest.imu_units import ImuUnits
from velod.types import ImuPacket

MAX_FROZEN = 3


def packets(seed: int) -> list[ImuPacket]:
    """Samples some of which are NaN, infinite, late or repeated, in packets of 0 to 9."""
    rng = np.random.default_rng(seed)
    n = 400
    t_ns = np.cumsum(rng.integers(-1, 6, n)) * 1_000_000
    value = np.repeat(rng.normal(size=(n, 6)), rng.integers(1, 8, n), axis=0)[:n]
    broken = rng.random(n) < 0.05
    value[broken, rng.integers(0, 6, broken.sum())] = rng.choice([np.nan, np.inf, -np.inf], broken.sum())
    cuts = [0, *np.cumsum(rng.integers(1, 10, n)).tolist()]
    parts = [slice(a, b) for a, b in pairwise(cuts) if a < n]
    return [ImuPacket(k, 0, t_ns[at], value[at, :3].copy(), value[at, 3:].copy()) for k, at in enumerate(parts)]


def twin(packets: list[ImuPacket]) -> tuple[list[int], Counter[str]]:
    """Times of the good samples, and how many of the others there are by cause."""
    good, causes = [], Counter[str]()
    last_t_ns, last, identical = -(2**62), [np.nan] * 6, 1
    for packet in packets:
        for t_ns, *value in zip(packet.sample_t_ns.tolist(), *packet.accel.T, *packet.gyro.T, strict=True):
            if not np.isfinite(value).all():
                causes["imu.nan"] += 1
            elif t_ns <= last_t_ns:
                causes["imu.backwards"] += 1
            else:
                identical = identical + 1 if value == last else 1
                last_t_ns, last = t_ns, value
                if identical > MAX_FROZEN:
                    causes["imu.frozen"] += 1
                else:
                    good.append(t_ns)
    return good, causes


@pytest.mark.parametrize("seed", range(5))
def test_good_samples_are_those_of_the_rule_however_they_are_packed(seed: int) -> None:
    counters: Counter[str] = Counter()
    settings = from_tree({"ingest": {"imu_frozen_samples": MAX_FROZEN}}).ingest
    stream = ImuStream(settings, 0.0, counters, Alarms())
    sent = packets(seed)
    good, causes = twin(sent)
    assert np.concatenate([t_ns for p in sent for t_ns, _, _ in stream.take(p)]).tolist() == good
    assert counters == causes
    assert min(causes.values()) > 0 and len(causes) == 3


def test_the_units_are_told_from_the_mean_norms_of_a_second() -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(101, 3))
    t_ns = np.arange(101) * 10_000_000
    for norm, doubted in ((2.49, True), (2.51, False)):
        units = ImuUnits()
        units.add(t_ns, rows * norm / np.linalg.norm(rows, axis=1).mean(), rows)
        assert ("is it in g?" in units.alarm) == doubted
