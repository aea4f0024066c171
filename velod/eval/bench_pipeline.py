"""What is measured of ingest, and of the stages chained: cases of ``velod bench``."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from velod.config import Settings, from_tree
from velod.eval import bench_input
from velod.eval.bench import Case, Size
from velod.eval.bench_input import RIG
from velod.ingest.stage import IngestStage
from velod.types import (
    EventPacket,
    ImuPacket,
    Velocity,
)
from velod.wire import decode, encode

Packets = Iterator[EventPacket | ImuPacket]
RunPipeline = Callable[[Packets], list[Velocity]]


def ingest(size: Size) -> Case:
    """``ingest.batch``: as many left and right events as a batch has: surfaces, selection, encoding."""
    settings = from_tree({"ingest": {"batch": "count", "count": size.events}})
    stage, stream = IngestStage(settings, RIG), bench_input.batch_packets(size.seconds, size.events)

    def run() -> list[bytes]:
        left, right = next(stream)
        return [encode(message, 1) for packet in (left, right) for message in stage.handle(packet)]

    return Case("ingest.batch", run)


def large_ingest(size: Size) -> Case:
    """``ingest.hd``: a whole stream of a 1280x720 pair as ingest's process handles it.

    Decoding of packets, filters, surfaces, selection, encoding. ``mev_s`` counts the events of both cameras.
    """
    packets = [encode(packet, 1) for packet in bench_input.large_packets(size.seconds, seed=1)]
    events = sum(len(packet.x) for packet in bench_input.large_packets(size.seconds, seed=1))

    def run() -> int:
        stage = IngestStage(Settings(), bench_input.LARGE_RIG)
        started_ns = time.perf_counter_ns()
        for data in packets:
            received: Any = decode(data).message
            for message in stage.handle(received):
                encode(message, 1)
        return time.perf_counter_ns() - started_ns

    return Case("ingest.hd", run, events=events, clocked=True)


def one_process(size: Size, run_pipeline: RunPipeline) -> Case:
    """``pipeline.one_process``: the stages chained on a whole stream, without network; a unit is a batch.

    ``mev_s`` counts the events of both cameras.
    """
    packets = list(bench_input.packets(size.seconds, seed=1))
    events = sum(len(p.x) for p in packets if isinstance(p, EventPacket))
    batches = max(1, round(events / 2 / size.events))

    def run() -> int:
        started_ns: list[int] = []
        run_pipeline(_noting_the_start(packets, started_ns))
        return time.perf_counter_ns() - started_ns[0]

    return Case("pipeline.one_process", run, per=batches, events=events, clocked=True)


def _noting_the_start(packets: list[EventPacket | ImuPacket], started_ns: list[int]) -> Packets:
    """The packets; when the first is asked for, the stages have been built."""
    started_ns.append(time.perf_counter_ns())
    yield from packets
