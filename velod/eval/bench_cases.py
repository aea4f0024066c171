"""What is measured, by the names that ``velod bench --json`` writes."""

from __future__ import annotations

from collections.abc import Iterator

from velod.config import Settings
from velod.depth.stage import DepthStage
from velod.eval.bench import Case, Size
from velod.eval.bench_input import RIG
from velod.eval.bench_pipeline import RunPipeline, ingest, large_ingest, one_process
from velod.eval.bench_solver import imu_rate, window
from velod.eval.bench_workers import codec, event_by_event, plane_fit, sae, selected, sparse_depth, worker
from velod.flow.stage import FlowStage

GROUPS = ("flow", "depth", "solve", "codec", "pipeline")


def cases(group: str, size: Size, run_pipeline: RunPipeline) -> Iterator[Case]:
    """The cases of one of GROUPS, each made when its turn comes. ``run_pipeline``: the stages chained."""
    if group == "flow":
        yield sae(size)
        event_batch, _ = selected(size)
        yield plane_fit(event_batch)
        yield event_by_event(size)
        yield worker("flow.worker", FlowStage(Settings(), RIG), event_batch)
    elif group == "depth":
        _, stereo_batch = selected(size)
        yield sparse_depth(stereo_batch)
        yield worker("depth.worker", DepthStage(Settings(), RIG), stereo_batch)
    elif group == "solve":
        yield window(size)
        yield imu_rate(size)
    elif group == "codec":
        yield codec(selected(size))
    elif group == "pipeline":
        yield ingest(size)
        yield large_ingest(size)
        yield one_process(size, run_pipeline)
    else:
        raise ValueError(f"no group {group!r}; groups: {', '.join(GROUPS)}")
