"""The depth stage: StereoBatch -> DepthBatch. Stateless but for its counters; no sockets, clock or threads."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from velod.config import Settings
from velod.depth.passage import NOWHERE, Choice, Passages, choose, passages, sensor_index
from velod.depth.refine import FLAT_EDGE, OUTCOMES, REFINED, Edges, Refined, left_edges, refine
from velod.depth.surroundings import SAME_TIME_PX, unmatched_share
from velod.depth.time_surface import TimeSurface, decay_table
from velod.depth.zncc import NONE, Matches, Surface, match
from velod.events.sensor_size import for_sensor
from velod.geometry.calibration import Calibration
from velod.geometry.rectify import rectify
from velod.types import F64, I64, DepthBatch, StereoBatch

Bools = NDArray[np.bool_]

# A confirmed match whose correlation reaches this share of the best one's is its rival.
_RIVAL_SHARE = 0.75
# So far from a passage, in px along the row and across it, may the time of a pixel be that still shows it: half a
# pixel of rounding each way, on the rectified grid and on the sensor.
_REACH_X_PX, _REACH_Y_PX = 1.0, 0.5
_REACH_NOISES = 2.5
# The way back ends at a whole pixel, and began at one.
_WHOLE_PX = 1.0
# Block matching along an edge that lies in the row: twice the spread of other edges, and an error that neighbours
# share, so that it must not average out over the tens of a batch.
_FLAT_EDGE_FACTOR = 10.0
# Between these shares of unmatched surroundings a place goes from being as good as others to telling nothing: in
# spins flows are off by 1.0 to 1.2 of their sigmas where half is unmatched, by 1.3 to 1.7 at 0.85, 2.2 where all is.
_MANY_UNMATCHED, _ALL_UNMATCHED = 0.75, 0.85


@dataclass(frozen=True, slots=True)
class _Batch:
    """A batch as it is matched: its events on the rectified images, and time surfaces of these."""

    message: StereoBatch
    left: Surface
    right_mirrored: Surface
    x: I64  # (n,) nearest rectified pixel, -1 where no block fits
    y: I64
    edges: Edges
    noise_s: float  # of time stamps

    @property
    def reach_s(self) -> F64:
        """(n,) by how much the time of a pixel where an edge passes may differ from that of the passage."""
        reach = _REACH_X_PX * np.abs(self.edges.slope_x) + _REACH_Y_PX * np.abs(self.edges.slope_y)
        return np.asarray(reach + _REACH_NOISES * self.noise_s)

    @property
    def same_time_s(self) -> F64:
        """(n,) by how much times may differ of which the same edge passes neighbouring pixels in both cameras."""
        slope = np.hypot(self.edges.slope_x, self.edges.slope_y)
        return np.asarray(SAME_TIME_PX * slope + _REACH_NOISES * self.noise_s)


class DepthStage:
    """Inverse depth at selected events, by block matching of time surfaces and plane coincidence."""

    def __init__(self, settings: Settings, calibration: Calibration) -> None:
        self.counters: Counter[str] = Counter()
        self._settings = for_sensor(settings, calibration.left.width, calibration.left.height).depth
        self._rectification = rect = rectify(calibration)
        self._left_shape = (calibration.left.height, calibration.left.width)
        self._right_shape = (calibration.right.height, calibration.right.width)
        self._left_index = sensor_index(rect.remap_left, self._left_shape)
        self._right_index = sensor_index(rect.remap_right, self._right_shape)
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
        batch = self._view(message)
        s = self._settings
        matches = match(batch.left, batch.right_mirrored, batch.x, batch.y, s.block_px, s.max_disparity_px)
        refined, choice = self._refine(batch, matches)
        is_refined = refined.outcome == REFINED
        disparity = np.where(is_refined, refined.disparity, matches.disparity)
        candidates = self._candidates(matches, refined.outcome, choice)
        accepted = candidates & self._unambiguous(batch, matches, disparity, candidates, is_refined)
        self.counters["points.ambiguous"] += int(np.count_nonzero(candidates & ~accepted))
        sigma_px = self._sigma_px(batch, refined, accepted)
        return [self._publish(message, disparity, sigma_px, is_refined, accepted)]

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

    def _view(self, message: StereoBatch) -> _Batch:
        """Events and time surfaces on the rectified grid, the right one mirrored."""
        if message.unit_ns != self._decay_unit_ns:
            self._decay_unit_ns = message.unit_ns
            self._decay = decay_table(message.unit_ns, 1e-3 * self._settings.tau_ms)
        noise_s = 1e-9 * message.time_noise_ns
        edges = left_edges(
            message.left, message.unit_ns, message.x, message.y, message.p, self._rectification, noise_s
        )
        x, y = _nearest_pixel(edges.x), _nearest_pixel(edges.y)
        x[self._overtaken(message)] = -1
        return _Batch(
            message=message,
            left=Surface.of(self._left_surface.render(message.left_last, self._decay)),
            right_mirrored=Surface.of(self._right_surface.render(message.right_last, self._decay)),
            x=x,
            y=y,
            edges=edges,
            noise_s=noise_s,
        )

    def _refine(self, batch: _Batch, matches: Matches) -> tuple[Refined, Choice]:
        """Plane coincidence wherever the right edge passes with the left one: of each point the match that looks most
        alike of those that it confirms, and how that was chosen."""
        message, edges, n = batch.message, batch.edges, len(batch.x)
        places, seed = Passages(np.arange(n), np.full(n, NOWHERE)), np.full(n, np.nan)
        if self._settings.refine:
            places = passages(
                message.right, message.unit_ns, self._right_index, batch.x, batch.y, message.p,
                edges.t_s, batch.reach_s, -1,
                (matches.scores, self._settings.min_zncc), self._settings.max_disparity_px,
            )  # fmt: skip
            at_place = places.disparity + (edges.x - batch.x)[places.of]
            seed = np.where(places.disparity == NOWHERE, matches.disparity[places.of], at_place)
        found = refine(
            edges, message.right, message.unit_ns, message.p, places.of, seed, self._rectification, batch.noise_s
        )
        choice = choose(places, found.disparity, matches.scores, _RIVAL_SHARE)
        refined = found[choice.best]
        count = np.bincount(refined.outcome, minlength=len(OUTCOMES))
        for number, name in enumerate(OUTCOMES):
            if number != REFINED and count[number]:
                self.counters[f"unrefined.{name}"] += int(count[number])
        return refined, choice

    def _candidates(self, matches: Matches, outcome: NDArray[np.uint8], choice: Choice) -> Bools:
        """(n,) which matches are worth checking: refined without a rival, or strong where that cannot be had."""
        s = self._settings
        matched = np.isfinite(matches.disparity)
        is_refined = np.asarray(outcome == REFINED)
        # On real events every sixth match that refinement could have confirmed and did not is off by half its depth.
        trusted = is_refined | (outcome == FLAT_EDGE) if s.refine and s.block_only == "flat" else matched
        score = np.where(is_refined, choice.score, np.where(matches.enclosed, matches.score, NONE))
        strong = matched & trusted & (score >= s.min_zncc)
        rivalled = strong & (choice.rival >= 0)
        self.counters["points.no_match"] += int(np.count_nonzero(~matched))
        self.counters["points.unconfirmed"] += int(np.count_nonzero(matched & ~trusted))
        self.counters["points.low_zncc"] += int(np.count_nonzero(matched & trusted & ~strong))
        # A repetitive texture matches itself at every period: left and right agree on the wrong one.
        self.counters["points.ambiguous"] += int(np.count_nonzero(rivalled))
        return strong & ~rivalled

    def _unambiguous(
        self, batch: _Batch, matches: Matches, disparity: F64, candidates: Bools, is_refined: Bools
    ) -> Bools:
        """(n,) which of the candidates pass the check that is set."""
        s = self._settings
        if s.check == "left-right":
            # Refined ones as well: on real events one in thirty sits on the wrong edge of a repetitive texture, and
            # of those that agree one in a hundred.
            back = self._match_back(batch, disparity, candidates, is_refined)
            allowed = s.left_right_px + np.where(is_refined, _WHOLE_PX, 0.0)
            return np.asarray(np.abs(back - disparity) <= allowed)
        if s.check == "uniqueness":
            return np.asarray(is_refined | (matches.second <= s.uniqueness * matches.score))
        return np.ones_like(candidates)

    def _match_back(self, batch: _Batch, disparity: F64, candidates: Bools, is_refined: Bools) -> F64:
        """(n,) disparities of the candidates' matches in the left image, NaN of the others.

        Found as the candidates were: refined ones among the places where a left edge passes with the right one.
        """
        s, at, message = self._settings, np.flatnonzero(candidates), batch.message
        x_right, y = batch.x[at] - np.rint(disparity[at]).astype(np.int64), batch.y[at]
        places = passages(
            message.left, message.unit_ns, self._left_index, x_right, y, message.p[at],
            batch.edges.t_s[at], batch.reach_s[at], 1, None, s.max_disparity_px,
        )  # fmt: skip
        # Where there is but one place likeness has nothing to choose.
        asked = ~is_refined[at] | (np.bincount(places.of, minlength=len(at)) > 1)
        # Mirrored, the right image takes the left one's part.
        mirrored_x = self._rectification.width - 1 - x_right[asked]
        back = match(batch.right_mirrored, batch.left, mirrored_x, y[asked], s.block_px, s.max_disparity_px)
        scores = np.full((len(at), back.scores.shape[1]), NONE)
        scores[asked] = back.scores
        at_place = np.where(places.disparity == NOWHERE, np.nan, places.disparity)
        found = at_place[choose(places, at_place, scores, _RIVAL_SHARE).best]
        found[~is_refined[at]] = back.disparity[~is_refined[at][asked]]
        out = np.full(len(disparity), np.nan)
        out[at] = found
        return out

    def _sigma_px(self, batch: _Batch, refined: Refined, accepted: Bools) -> F64:
        """(n,) disparity sigma: for refined points from the planes' residuals and the edge's slope along the row.

        Beside a jump of depth it grows up to the disparity itself: which surface an edge there is of is not known,
        and its flow is no better.
        """
        s = self._settings
        block = np.where(refined.outcome == FLAT_EDGE, _FLAT_EDGE_FACTOR, 1.0) * s.sigma_zncc_px
        sigma = np.where(refined.outcome == REFINED, np.hypot(refined.sigma_px, s.sigma_refined_px), block)
        at = np.flatnonzero(accepted & (refined.outcome == REFINED))
        message, disparity = batch.message, refined.disparity[at]
        share = unmatched_share(
            message.left, message.right, message.unit_ns, self._left_index, self._right_index,
            batch.x[at], batch.y[at], message.p[at], disparity, batch.same_time_s[at],
        )  # fmt: skip
        doubt = np.clip((share - _MANY_UNMATCHED) / (_ALL_UNMATCHED - _MANY_UNMATCHED), 0.0, 1.0)
        sigma[at] = np.hypot(sigma[at], doubt * disparity)
        return np.asarray(sigma)

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


def _nearest_pixel(x: F64) -> I64:
    """Rounded positions; -1, where no block fits, for NaN."""
    return np.asarray(np.nan_to_num(np.floor(x + 0.5), nan=-1.0), dtype=np.int64)
