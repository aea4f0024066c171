"""Flow that comes in parts is the flow of the whole batch, in whatever order the parts come."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from tests.synthetic import CALIBRATION, FLIGHT, messages
from velod.config import Settings
from velod.optimizer.parts import Parts, batch_seq
from velod.optimizer.stage import OptimizerStage
from velod.types import DepthBatch, FlowBatch, ImuSamples, Velocity

Batch = FlowBatch | DepthBatch | ImuSamples


def split(flow: FlowBatch, at: list[int], seq: int, t_start_ns: int) -> list[FlowBatch]:
    """The flows between the positions ``at``, as parts that end a little before each other."""
    parts = []
    bounds = [0, *at, flow.n_selected]
    for k, (a, b) in enumerate(pairwise(bounds)):
        inside = (flow.index >= a) & (flow.index < b)
        # An event must have happened before its part ends.
        early = 0 if not inside.any() else min(1_000_000, int(flow.age[inside].min()) - 1)
        columns = {name: getattr(flow, name)[inside] for name in ("x", "y", "n", "speed", "sigma")}
        part = replace(flow, seq=seq + k, t_ns=flow.t_ns - early, n_selected=b - a, **columns)
        index, age = (flow.index[inside] - np.uint16(a)).astype(np.uint16), flow.age[inside] - np.uint32(early)
        parts.append(replace(part, index=index, age=age, batch_seq=flow.seq, first=a, t_start_ns=t_start_ns))
    return parts


def in_parts(stream: tuple[Batch, ...]) -> list[Batch]:
    out: list[Batch] = []
    seq = 0
    for m in stream:
        if isinstance(m, FlowBatch):
            start = m.t_ns - 15_000_000
            parts = split(m, [70, 71, 200], seq, start)
            seq += len(parts)
            out += parts
        else:
            out.append(replace(m, t_start_ns=m.t_ns - 15_000_000) if isinstance(m, DepthBatch) else m)
    return out


def velocities(stream: list[Batch]) -> list[tuple[int, bytes]]:
    stage = OptimizerStage(Settings(), CALIBRATION)
    out = [o for m in stream for o in stage.handle(m)]
    assert not {name for name in stage.counters if name.startswith("batch.")}
    return [(v.t_ns, v.v_B.tobytes() + v.cov.tobytes()) for v in out if isinstance(v, Velocity)]


def test_parts_in_any_order_lead_to_the_velocities_of_whole_batches_to_the_bit() -> None:
    stream = messages(FLIGHT, 0.5)
    whole = velocities(list(stream))
    parts = in_parts(stream)
    assert len(whole) > 30
    assert velocities(parts) == whole
    # Every batch's messages among themselves, and no word of a batch before its predecessor's.
    rng = np.random.default_rng(1)
    shuffled: list[Batch] = []
    for k in range(0, len(parts) - 5, 6):
        group = parts[k : k + 6]
        shuffled += [group[i] for i in rng.permutation(len(group))]
    shuffled += parts[len(shuffled) :]
    assert [t for t, _ in velocities(shuffled)] == [t for t, _ in whole]
    assert velocities(shuffled) == whole


def one_batch() -> tuple[list[FlowBatch], DepthBatch]:
    flow = next(m for m in messages(FLIGHT, 0.1) if isinstance(m, FlowBatch))
    depth = next(m for m in messages(FLIGHT, 0.1) if isinstance(m, DepthBatch))
    return split(flow, [100], 5, 0), replace(depth, t_start_ns=0)


def test_a_batch_is_whole_once_the_flow_of_all_its_events_is_there() -> None:
    flows, depth = one_batch()
    parts = Parts()
    assert all(batch_seq(f) == depth.seq for f in flows)
    for part in (flows[1], depth):
        assert parts.add(part)
        assert parts.whole is None
    assert parts.add(flows[0])
    assert parts.whole is depth


def test_a_part_that_comes_twice_counts_once() -> None:
    flows, depth = one_batch()
    parts = Parts()
    for part in (depth, flows[0], flows[0]):
        parts.add(part)
    assert parts.whole is None
    parts.add(flows[1])
    assert len(parts.joined(depth).index) == sum(len(f.index) for f in flows)


def test_parts_of_two_ingests_are_told_apart_and_the_newer_stay() -> None:
    flows, depth = one_batch()
    later = [replace(f, t_ns=f.t_ns + 10**9, t_start_ns=10**9) for f in flows]
    parts = Parts()
    assert parts.add(flows[0])
    assert not parts.add(later[0])
    assert not parts.add(depth)
    assert parts.flows == {0: later[0]} and parts.depth is None
