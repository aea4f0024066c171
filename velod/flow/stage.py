"""Flow worker: selected events with their neighbourhoods in, normal flow with its sigma out (Eq. 5-6)."""

from __future__ import annotations

from collections import Counter

import numpy as np

from velod.config import Settings
from velod.events.columns import readonly
from velod.events.plane_fit import SIZE
from velod.flow.kernel import REFUSALS, fit_flows
from velod.geometry.calibration import Calibration
from velod.geometry.rectify import rectify
from velod.types import RING, EventBatch, FlowBatch


class FlowStage:
    """Stateless but for ``counters``: the flows of a batch depend on nothing but the batch.

    ``counters``: "batches", "flows", "batches.malformed", and one per cause of refusal, "flow.<cause>".
    """

    def __init__(self, settings: Settings, calibration: Calibration) -> None:
        self.counters: Counter[str] = Counter()
        self._settings = settings.flow
        self.rectification = rectify(calibration)
        self._xy = np.ascontiguousarray(self.rectification.left_xy, np.float32)
        self._covector = np.ascontiguousarray(self.rectification.left_covector, np.float32)

    def handle(self, message: EventBatch) -> list[FlowBatch]:
        """One FlowBatch per EventBatch, possibly empty; none where the batch cannot be read."""
        if not self._well_formed(message):
            self.counters["batches.malformed"] += 1
            return []
        s, m = self._settings, message
        size = len(m.x)
        index = np.empty(size, np.uint16)
        flow = np.empty((size, 6), np.float32)
        refused = np.zeros(len(REFUSALS), np.int64)
        n = fit_flows(
            readonly(m.x, np.uint16), readonly(m.y, np.uint16),
            readonly(m.patch, np.uint32), readonly(m.ring, np.uint32),
            self._xy, self._covector,
            s.reject_px, s.rejections, s.min_neighbours, s.max_rms_px, s.max_speed_px_s, s.method == "benosman",
            1e-9 * m.time_noise_ns,
            index, flow, refused,
        )  # fmt: skip
        self.counters["batches"] += 1
        self.counters["flows"] += n
        for cause, count in zip(REFUSALS, refused.tolist(), strict=True):
            self.counters[f"flow.{cause}"] += count
        index, flow = index[:n], flow[:n]
        x, y, nx_ny, speed, sigma = (np.ascontiguousarray(flow[:, k]) for k in (0, 1, slice(2, 4), 4, 5))
        batch = (m.batch_seq, m.first, m.t_start_ns, m.n_events)
        return [FlowBatch(m.seq, m.t_ns, size, index, m.age[index], x, y, nx_ny, speed, sigma, *batch)]

    def _well_formed(self, m: EventBatch) -> bool:
        h, w = self._xy.shape[:2]
        size = len(m.x)
        if not len(m.y) == len(m.age) == len(m.p) == size or size > 65_535:
            return False
        if m.patch.shape != (size, SIZE) or m.ring.shape not in ((size, RING), (0, RING)):
            return False
        return size == 0 or (int(m.x.max()) < w and int(m.y.max()) < h)
