"""The depth stage: StereoBatch -> DepthBatch. Stateless but for its counters; no sockets, clock or threads."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from velod.config import Settings
from velod.depth.refine import FLAT_EDGE, OUTCOMES, REFINED, Refined, refine
from velod.depth.time_surface import TimeSurface, decay_table
from velod.depth.zncc import Matches, Surface, match
from velod.events.sensor_size import for_sensor
from velod.geometry.calibration import Calibration
from velod.geometry.rectify import rectify
from velod.types import F32, F64, I64, DepthBatch, StereoBatch

Bools = NDArray[np.bool_]

# Where the second peak of the correlation reaches this share of the first, refinement decides whether it is a rival.
_RIVAL_SHARE = 0.75
_RIVAL_PX = 2.0
# Block matching along an edge that lies in the row: twice the spread of other edges, and an error that neighbours
# share, so that it must not average out.
_FLAT_EDGE_FACTOR = 4.0


class DepthStage:
    """Inverse depth at selected events, by block matching of time surfaces and plane coincidence."""

    def __init__(self, settings: Settings, calibration: Calibration) -> None:
        self.counters: Counter[str] = Counter()
        self._settings = for_sensor(settings, calibration.left.width, calibration.left.height).depth
        self._rectification = rect = rectify(calibration)
        self._left_shape = (calibration.left.height, calibration.left.width)
        self._right_shape = (calibration.right.height, calibration.right.width)
        self._left_surface = TimeSurface(None if rect.identity else rect.remap_left)
        self._right_surface = TimeSurface(None if rect.identity else rect.remap_right, mirrored=True)
        self._decay_unit_ns = 0
        self._decay = np.empty(0, np.float32)

    def handle(self, message: StereoBatch) -> list[DepthBatch]:
        """One DepthBatch for a StereoBatch; none (counted ``batches.size``) where it does not fit the calibration.

        Counters: ``points`` seen, of them ``points.refined`` and ``points.block`` published, ``points.no_match``
        (``points.overtaken`` among them),
        ``points.unconfirmed``, ``points.low_zncc``, ``points.ambiguous`` and ``points.too_far`` dropped, and
        ``unrefined.<why>``.
        """
        if not self._fits(message):
            self.counters["batches.size"] += 1
            return []
        xy = self._rectification.left_xy[message.y, message.x]
        left, right_mirrored = self._surfaces(message)
        x, y = _nearest_pixel(xy[:, 0]), _nearest_pixel(xy[:, 1])
        x[self._overtaken(message)] = -1
        matches = match(left, right_mirrored, x, y, self._settings.block_px, self._settings.max_disparity_px)
        refined = self._refine(message, matches.disparity)
        is_refined = refined.outcome == REFINED
        disparity = np.where(is_refined, refined.disparity, matches.disparity)
        accepted = self._accept(left, right_mirrored, x, y, matches, disparity, refined.outcome)
        accepted &= ~self._has_rival(message, matches, disparity, accepted & is_refined)
        return [self._publish(message, disparity, self._sigma_px(refined), is_refined, accepted)]

    def _fits(self, message: StereoBatch) -> bool:
        """The surfaces and the events are on the sensors of the calibration."""
        h, w = self._left_shape
        return (
            message.left.shape == (2, *self._left_shape)
            and message.left_last.shape == self._left_shape
            and message.right.shape == (2, *self._right_shape)
            and message.right_last.shape == self._right_shape
            and int(message.x.max(initial=0)) < w
            and int(message.y.max(initial=0)) < h
            and int(message.p.max(initial=0)) < 2
            and message.unit_ns > 0
        )

    def _overtaken(self, message: StereoBatch) -> Bools:
        """(n,) where the surface no longer holds the event: a depth there would be that of another edge.

        So it can be where events are selected before the batch's end (``ingest.mode = "event"``).
        """
        held = message.left[message.p, message.y, message.x].astype(np.int64) * message.unit_ns
        overtaken = np.asarray(held < message.age)
        self.counters["points.overtaken"] += int(np.count_nonzero(overtaken))
        return overtaken

    def _surfaces(self, message: StereoBatch) -> tuple[Surface, Surface]:
        """Time surfaces on the rectified grid: the left one, and the right one mirrored."""
        if message.unit_ns != self._decay_unit_ns:
            self._decay_unit_ns = message.unit_ns
            self._decay = decay_table(message.unit_ns, 1e-3 * self._settings.tau_ms)
        return (
            Surface.of(self._left_surface.render(message.left_last, self._decay)),
            Surface.of(self._right_surface.render(message.right_last, self._decay)),
        )

    def _refine(self, message: StereoBatch, disparity_px: F32) -> Refined:
        """Plane coincidence, seeded by the best match whatever its score."""
        seed = disparity_px if self._settings.refine else np.full_like(disparity_px, np.nan)
        refined = refine(
            message.left,
            message.right,
            message.unit_ns,
            message.x,
            message.y,
            message.p,
            seed,
            self._rectification,
            1e-9 * message.time_noise_ns,
        )
        count = np.bincount(refined.outcome, minlength=len(OUTCOMES))
        for number, name in enumerate(OUTCOMES):
            if number != REFINED and count[number]:
                self.counters[f"unrefined.{name}"] += int(count[number])
        return refined

    def _accept(
        self,
        left: Surface,
        right_mirrored: Surface,
        x: I64,
        y: I64,
        matches: Matches,
        disparity: F64,
        outcome: NDArray[np.uint8],
    ) -> Bools:
        """(n,) which disparities stand: refined or of a strong match, and checked against ambiguity."""
        s = self._settings
        matched = np.isfinite(disparity)
        is_refined = np.asarray(outcome == REFINED)
        # On real events every sixth match that refinement could have confirmed and did not is off by half its depth.
        trusted = is_refined | (outcome == FLAT_EDGE) if s.refine and s.block_only == "flat" else matched
        strong = is_refined | (matched & trusted & matches.enclosed & (matches.score >= s.min_zncc))
        accepted = strong
        if s.check == "left-right":
            # Refined ones as well: on real events one in thirty sits on the wrong edge of a repetitive texture, and
            # of those that agree one in a hundred.
            accepted = self._left_right_agree(left, right_mirrored, x, y, disparity, strong)
        elif s.check == "uniqueness":
            accepted = is_refined | (strong & (matches.second <= s.uniqueness * matches.score))
        self.counters["points.no_match"] += int(np.count_nonzero(~matched))
        self.counters["points.unconfirmed"] += int(np.count_nonzero(matched & ~trusted))
        self.counters["points.low_zncc"] += int(np.count_nonzero(matched & trusted & ~strong))
        self.counters["points.ambiguous"] += int(np.count_nonzero(strong & ~accepted))
        return accepted

    def _has_rival(self, message: StereoBatch, matches: Matches, disparity: F64, among: Bools) -> Bools:
        """(n,) refined points whose second match is nearly as good, and confirmed by plane coincidence as well.

        A repetitive texture matches itself a period away in both directions: left and right agree on the wrong one.
        """
        at = np.flatnonzero(among & (matches.second >= _RIVAL_SHARE * matches.score))
        second = refine(
            message.left,
            message.right,
            message.unit_ns,
            message.x[at],
            message.y[at],
            message.p[at],
            matches.rival[at],
            self._rectification,
            1e-9 * message.time_noise_ns,
        )
        out = np.zeros_like(among)
        out[at] = (second.outcome == REFINED) & (np.abs(second.disparity - disparity[at]) > _RIVAL_PX)
        self.counters["points.ambiguous"] += int(np.count_nonzero(out))
        return out

    def _left_right_agree(
        self, left: Surface, right_mirrored: Surface, x: I64, y: I64, disparity: F64, candidates: Bools
    ) -> Bools:
        """Those candidates whose match in the right image has its own best match back here."""
        at = np.flatnonzero(candidates)
        x_right = x[at] - np.rint(disparity[at]).astype(np.int64)
        # Mirrored, the right image takes the left one's part.
        back = match(
            right_mirrored,
            left,
            self._rectification.width - 1 - x_right,
            y[at],
            self._settings.block_px,
            self._settings.max_disparity_px,
        )
        out = np.zeros_like(candidates)
        out[at] = np.abs(back.disparity - disparity[at]) <= self._settings.left_right_px
        return out

    def _sigma_px(self, refined: Refined) -> F64:
        """(n,) disparity sigma: for refined points from the planes' residuals and the edge's slope along the row."""
        s = self._settings
        block = np.where(refined.outcome == FLAT_EDGE, _FLAT_EDGE_FACTOR, 1.0) * s.sigma_zncc_px
        return np.asarray(np.where(refined.outcome == REFINED, np.hypot(refined.sigma_px, s.sigma_refined_px), block))

    def _publish(
        self, message: StereoBatch, disparity: F64, sigma_px: F64, is_refined: Bools, accepted: Bools
    ) -> DepthBatch:
        near = accepted & (disparity >= self._settings.min_disparity_px)
        self.counters["points"] += message.x.shape[0]
        self.counters["points.too_far"] += int(np.count_nonzero(accepted & ~near))
        self.counters["points.refined"] += int(np.count_nonzero(near & is_refined))
        self.counters["points.block"] += int(np.count_nonzero(near & ~is_refined))
        index = np.flatnonzero(near)
        # Z = f b / d
        per_px = 1.0 / (self._rectification.f * self._rectification.baseline_m)
        return DepthBatch(
            seq=message.seq,
            t_ns=message.t_ns,
            n_selected=message.x.shape[0],
            index=index.astype(np.uint16),
            disparity=disparity[index].astype(np.float32),
            inv_depth=(disparity[index] * per_px).astype(np.float32),
            sigma=(sigma_px[index] * per_px).astype(np.float32),
            refined=is_refined[index].astype(np.uint8),
            t_start_ns=message.t_start_ns,
        )


def _nearest_pixel(x: F32) -> I64:
    """Rounded positions; -1, where no block fits, for NaN."""
    return np.asarray(np.nan_to_num(np.floor(x + np.float32(0.5)), nan=-1.0), dtype=np.int64)
