"""Ingest: raw events and IMU samples in; selected events, surfaces and checked samples out.

The batches depend on the streams alone: not on how a driver cuts them into packets, nor (as long as no camera lags by
more than ``max_skew_ms``) on how the packets of the cameras and the IMU interleave.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from velod.alarms import Alarms
from velod.config import Settings
from velod.events.plane_fit import SIZE
from velod.events.sae import NEVER, age_unit_ns, encode_ages, encode_newest, gather_patches
from velod.events.selection import select_burst, select_paper
from velod.events.sensor_size import for_sensor
from velod.events.time_noise import MOST_PLANES, TimeNoise
from velod.geometry.calibration import Calibration
from velod.ingest.batch import OpenBatch
from velod.ingest.budget import Budget
from velod.ingest.imu import ImuStream
from velod.ingest.ordering import ClockRestart
from velod.ingest.slices import Slices
from velod.ingest.stream import CameraStream
from velod.types import (
    F64,
    I64,
    NS_PER_S,
    RING,
    U8,
    U16,
    U32,
    EventBatch,
    EventPacket,
    ImuPacket,
    ImuSamples,
    StereoBatch,
)

Output = EventBatch | StereoBatch | ImuSamples


class IngestStage:
    """Owns the surfaces of both cameras.

    ``counters``: "events" taken in, "batches", "batches.without_right", "clock.restart", drops by cause
    ("packets.*", "events.*", "imu.*") and by the budget ("shed.events", "shed.batches"). ``alarms``: what is wrong
    at the moment ("camera.left", "camera.right", "imu.frozen"). ``budget``: what may be taken on, from the next
    message on.
    """

    def __init__(self, settings: Settings, calibration: Calibration) -> None:
        self.counters: Counter[str] = Counter()
        self.alarms = Alarms()
        self.budget = Budget()
        settings = for_sensor(settings, calibration.left.width, calibration.left.height)
        self._settings = settings
        self._calibration = calibration
        self._memory_ns = round(settings.ingest.memory_ms * 1e6)
        self._skew_ns = round(settings.ingest.max_skew_ms * 1e6)
        self._batch_seq = -1
        self._imu_seq = -1
        self._turn = 0.0  # a batch is made when it reaches 1
        self._output_hz = settings.optimizer.output_hz
        cal = calibration
        by_event = settings.ingest.mode == "event"
        self._slices = Slices(settings, cal.left.width, cal.left.height) if by_event else None
        self._start_epoch()

    def _start_epoch(self) -> None:
        """Forget everything of the sensor's clock so far."""
        s, cal = self._settings.ingest, self._calibration
        self._left = CameraStream(s, cal.left.width, cal.left.height, self.counters)
        self._right = CameraStream(s, cal.right.width, cal.right.height, self.counters)
        self._imu = ImuStream(s, cal.time_offset_s, self.counters, self.alarms)
        self._taken = self._left.clock.new_surface()
        self._open = OpenBatch(s, self._output_hz)
        # The paper's rules know nothing of it.
        self._time_noise = TimeNoise(self._settings.flow) if s.selection == "burst" else None
        self._batch_t_ns = NEVER
        self._told_ns = NEVER  # how far the events had come by the newest word
        if self._slices is not None:
            # Parts of a batch that will never be whole must not join another one.
            self._batch_seq += self._slices.has_sent
            self._slices.begin_epoch(self._left)
        self.alarms.clear()

    def handle(self, message: EventPacket | ImuPacket) -> list[Output]:
        """Batches that the message closes (each as StereoBatch, EventBatch, ImuSamples), or its IMU samples.

        Where the optimizer may wait to hear that no batch ended before an output, ImuSamples without a sample say so.
        Event by event, the EventBatches are slices, and go out before the StereoBatch of the same events.
        """
        if isinstance(message, ImuPacket):
            return self._on_imu(message)
        return self._on_events(message)

    def _on_events(self, packet: EventPacket) -> list[Output]:
        if packet.camera not in ("left", "right"):
            self.counters["packets.camera"] += 1
            return []
        if not len(packet.x) == len(packet.y) == len(packet.p) == len(packet.event_t_ns):
            self.counters["packets.malformed"] += 1
            return []
        try:
            ordered = self._camera(packet).order.push(packet)
        except ClockRestart:
            self.counters["clock.restart"] += 1
            self._start_epoch()
            ordered = self._camera(packet).order.push(packet)
        for p in ordered:
            self._camera(p).accept(p, self.budget.band_rows)
        return [*self._close_batches(), *self._word_of_events()] if ordered else []

    def _camera(self, packet: EventPacket) -> CameraStream:
        return self._left if packet.camera == "left" else self._right

    def _on_imu(self, packet: ImuPacket) -> list[Output]:
        try:
            taken = self._imu.take(packet)
        except ClockRestart:
            self.counters["clock.restart"] += 1
            self._start_epoch()
            taken = self._imu.take(packet)
        return [self._imu_samples(self._event_t_ns, *samples) for samples in taken]

    def _imu_samples(self, event_t_ns: int, t_ns: I64, accel: F64, gyro: F64) -> ImuSamples:
        """With word of how far the events have come; a time of which nothing has been heard is said as 0."""
        self._imu_seq += 1
        self._told_ns = event_t_ns
        newest, events, batch = (0 if t == NEVER else t for t in (self._imu.t_ns, event_t_ns, self._batch_t_ns))
        return ImuSamples(self._imu_seq, newest, events, self._batch_seq, batch, t_ns, accel, gyro)

    @property
    def _event_t_ns(self) -> int:
        """The open batch ends after every left event that is known, and at its end where that is known."""
        open_end = self._open.t_end_ns
        event_t_ns = self._left.watermark_ns if open_end is None else open_end - 1
        return max(event_t_ns, self._batch_t_ns)

    def _word_of_events(self) -> list[ImuSamples]:
        """One, where events have passed the time of an output since the last word.

        With the next samples of the IMU it would come late by so much.
        """
        told, now = (t_ns * self._output_hz // NS_PER_S for t_ns in (self._told_ns, self._event_t_ns))
        return [self._no_samples(self._event_t_ns)] if now > told and self._imu.t_ns != NEVER else []

    def _close_batches(self) -> list[Output]:
        out: list[Output] = []
        while True:
            left, right, batch = self._left, self._right, self._open
            batch.find_end(left.queue.peek()[2], left.watermark_ns, self.budget.spaced)
            horizon = batch.horizon_ns(left.watermark_ns)
            out += self._enter_left(horizon)
            # Events of the right camera do not pile up while the left one is silent.
            right.enter_before(max(horizon, right.watermark_ns - self._skew_ns))
            if batch.t_start_ns is None or batch.t_end_ns is None or not self._is_complete(batch.t_end_ns):
                break
            if not batch.is_idle():
                out += self._emit_within_budget(batch.t_start_ns, batch.t_end_ns, batch.n)
            batch.begin_next()
        self._watch_skew()
        return out

    def _enter_left(self, horizon_ns: int) -> list[Output]:
        """Move left events of the open batch into the surfaces; returns what event-by-event mode selects of them."""
        if self._slices is None:
            self._open.fill(self._left.enter_before(horizon_ns))
            return []
        return [*self._slices.advance(self._open, self._batch_seq + 1, horizon_ns, self.budget, self._noise_ns)]

    def _is_complete(self, t_end_ns: int) -> bool:
        """Whether all events before ``t_end_ns`` are known, or will not be waited for."""
        if self._left.watermark_ns < t_end_ns:
            return False
        if self._right.watermark_ns >= t_end_ns:
            return True
        if self._left.watermark_ns - t_end_ns < self._skew_ns:
            return False
        self.counters["batches.without_right"] += 1
        return True

    def _watch_skew(self) -> None:
        """An alarm for the camera that lags behind the other."""
        lag_ns = self._left.watermark_ns - self._right.watermark_ns
        for name, behind in (("right", lag_ns), ("left", -lag_ns)):
            lags = f"the {name} camera lags by more than {self._skew_ns / 1e6:g} ms"
            self.alarms.say(f"camera.{name}", lags if behind >= self._skew_ns else "")

    def _emit_within_budget(self, t_start_ns: int, t_end_ns: int, n_events: int) -> list[Output]:
        """A batch that is not made has no number, so nobody waits for it.

        What was selected of it event by event belongs to the next one.
        """
        self._turn = min(self._turn, 1.0) + self.budget.batches
        if self.budget.room <= 0 or self._turn < 1.0:
            self.counters["shed.batches"] += 1
            return [self._no_samples(t_end_ns)]
        self._turn -= 1.0
        self.budget = replace(self.budget, room=self.budget.room - 1)
        return self._emit(t_start_ns, t_end_ns, n_events)

    def _emit(self, t_start_ns: int, t_end_ns: int, n_events: int) -> list[Output]:
        self._batch_seq += 1
        self._batch_t_ns = t_end_ns
        self.counters["batches"] += 1
        seq, memory_ns = self._batch_seq, self._memory_ns
        cameras = [(camera, camera.clock.stamp(t_end_ns)) for camera in (self._left, self._right)]
        left, right = (encode_ages(camera.first, t_end, memory_ns) for camera, t_end in cameras)
        left_last, right_last = (encode_newest(camera.last, t_end, memory_ns) for camera, t_end in cameras)
        noise_ns = self._noise_ns
        event_batches: list[EventBatch]
        if self._slices is None:
            x, y, age, p, patch, ring = self._select(left, t_start_ns, t_end_ns)
            event_batches = [
                EventBatch(
                    seq, t_end_ns, t_start_ns, n_events, x, y, age, p, patch, seq, ring=ring, time_noise_ns=noise_ns
                )
            ]
        else:
            patch = self._slices.patches(t_end_ns, MOST_PLANES)
            x, y, age, p = self._slices.selected(t_end_ns)
            event_batches = self._slices.rest_of(self._open, seq, t_end_ns)
            t_start_ns = self._slices.begin_batch()
        if self._time_noise is not None:
            self._time_noise.learn(patch)
        unit_ns = age_unit_ns(memory_ns)
        return [
            StereoBatch(
                seq, t_end_ns, t_start_ns, unit_ns, x, y, age, p, left, right, left_last, right_last, noise_ns
            ),
            *event_batches,
            self._no_samples(t_end_ns),
        ]

    def _select(self, encoded: U16, t_start_ns: int, t_end_ns: int) -> tuple[U16, U16, U32, U8, U32, U32]:
        """x, y, age, p, patch and ring of an EventBatch: the paper's rules go with the paper's 5x5 alone."""
        s, fit, memory_ns = self._settings.ingest, self._settings.flow, self._memory_ns
        quota = self.budget.quota(s.quota)
        span = (self._left.clock.stamp(t_start_ns), self._left.clock.stamp(t_end_ns))
        if s.selection == "burst":
            surface = self._left.first
            x, y, p = select_burst(
                surface, self._taken, encoded, *span,
                memory_ns=memory_ns, reject_px=fit.reject_px, rejections=fit.rejections,
                min_neighbours=s.min_neighbours, max_rms_px=fit.max_rms_px,
                border_px=s.border_px, quota=quota, seq=self._batch_seq, time_noise_s=1e-9 * self._noise_ns,
            )  # fmt: skip
        else:
            surface = self._left.last
            x, y, p = select_paper(
                surface, *span,
                memory_ns=memory_ns, time_share=s.paper_time_share,
                border_px=s.border_px, quota=quota, seq=self._batch_seq,
            )  # fmt: skip
        age, patch = np.empty(len(x), np.uint32), np.empty((len(x), SIZE), np.uint32)
        ring = np.empty((len(x) if s.selection == "burst" else 0, RING), np.uint32)
        gather_patches(surface, x, y, p, span[1], memory_ns, age, patch, ring)
        return x, y, age, p, patch, ring

    @property
    def _noise_ns(self) -> int:
        """What is known of the time stamps' errors."""
        return 0 if self._time_noise is None else self._time_noise.sigma_ns

    def _no_samples(self, event_t_ns: int) -> ImuSamples:
        """Tells the optimizer how far the events have come without waiting for the IMU."""
        no_rows = np.empty((0, 3))
        return self._imu_samples(event_t_ns, np.empty(0, np.int64), no_rows, no_rows)
