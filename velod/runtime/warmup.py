"""Run each stage on a tiny made-up input, so that its kernels are compiled, cached and loaded before real ones come.

The input is one picture: slanted edges that move to the right at one depth, in closed form.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from velod.config import Settings
from velod.geometry.calibration import Calibration, Camera
from velod.runtime.kernel_cache import ensure_cache_directory
from velod.runtime.stages import STAGES, create_stage
from velod.types import (
    F64,
    NS_PER_S,
    PATCH,
    DepthBatch,
    EventBatch,
    EventPacket,
    FlowBatch,
    ImuPacket,
    ImuSamples,
    Message,
    StereoBatch,
)

# At uneven distances, as what repeats itself matches anywhere. They reach beyond every sensor.
_EDGES_PX = 24.0 * (np.arange(-200, 400) + 0.4 * np.mod(0.618 * np.arange(600), 1.0))
_SLANT = 0.3  # columns per row
_SPEED_PX_S = 250.0
_DISPARITY_PX = 8
_BATCH_NS = 20_000_000
_IMU_NS = 5_000_000
_SECONDS = 1.3  # longer than the window, so that its oldest segment leaves it
_SPECIFIC_FORCE = (0.0, -9.81, 0.0)  # at rest, y down


def fill_cache(settings: Settings, calibration: Calibration | None = None) -> None:
    """Compile and cache the kernels of all stages; without a calibration for a plain pair of cameras."""
    ensure_cache_directory()
    for stage in STAGES:
        warm_up(stage, settings, calibration or plain_calibration())
    # Ingest has kernels of its own in each of its modes.
    other = replace(settings.ingest, mode="event" if settings.ingest.mode == "batch" else "batch", selection="burst")
    warm_up("ingest", replace(settings, ingest=other), calibration or plain_calibration())


def plain_calibration() -> Calibration:
    """A rectified pair without distortion, DAVIS346-sized."""
    camera = Camera(width=346, height=260, fx=230.0, fy=230.0, cx=172.5, cy=129.5)
    return Calibration(left=camera, right=camera, R_RL=np.eye(3), t_RL=np.array([-0.1, 0.0, 0.0]))


def warm_up(stage: str, settings: Settings, calibration: Calibration) -> int:
    """Feed a stage of its own kind with made-up messages; returns how many messages it put out."""
    messages = {"ingest": _packets, "flow": _event_batches, "depth": _stereo_batches, "optimizer": _estimates}
    built = create_stage(stage, settings, calibration)
    return sum(len(built.handle(message)) for message in messages[stage](calibration))


def _crossing_px(width: int, height: int, shift_px: int) -> tuple[F64, F64]:
    """(h, w) px by which each pixel lies behind the nearest edge on its right, and ahead of that on its left."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    place = x + shift_px - _SLANT * y
    right = np.searchsorted(_EDGES_PX, place)
    return _EDGES_PX[right] - place, place - _EDGES_PX[right - 1]


def _packets(calibration: Calibration) -> Iterator[Message]:
    t_ns = np.arange(1, 31, dtype=np.int64) * _IMU_NS
    yield ImuPacket(0, int(t_ns[-1]), t_ns, np.tile(_SPECIFIC_FORCE, (len(t_ns), 1)), np.zeros((len(t_ns), 3)))
    for name, camera, shift_px in (("left", calibration.left, 0), ("right", calibration.right, _DISPARITY_PX)):
        _, ahead_px = _crossing_px(camera.width, camera.height, shift_px)
        reached_ns = (ahead_px / _SPEED_PX_S * NS_PER_S).ravel()
        order = np.argsort(reached_ns, kind="stable")
        y, x = np.divmod(order, camera.width)
        yield EventPacket(
            seq=0,
            t_ns=int(t_ns[-1]),
            camera=name,
            x=x.astype(np.uint16),
            y=y.astype(np.uint16),
            event_t_ns=reached_ns[order].astype(np.int64),
            p=np.ones(len(order), np.uint8),
        )


def _selected(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of a grid of events."""
    y, x = np.mgrid[24 : camera.height - 24 : 16, 64 : camera.width - 24 : 12]
    return x.ravel().astype(np.uint16), y.ravel().astype(np.uint16)


def _event_batches(calibration: Calibration) -> Iterator[Message]:
    x, y = _selected(calibration.left)
    row, column = np.mgrid[-(PATCH // 2) : PATCH // 2 + 1, -(PATCH // 2) : PATCH // 2 + 1]
    # The edge passes columns on the right later: those are younger.
    age_s = 0.03 - (column - _SLANT * row).ravel() / _SPEED_PX_S
    patch = np.tile((age_s * NS_PER_S).astype(np.uint32), (len(x), 1))
    age = np.ascontiguousarray(patch[:, PATCH * PATCH // 2])
    yield EventBatch(0, NS_PER_S, NS_PER_S - _BATCH_NS, len(x), x, y, age, np.ones(len(x), np.uint8), patch)


def _stereo_batches(calibration: Calibration) -> Iterator[Message]:
    x, y = _selected(calibration.left)
    unit_ns = 1600
    surfaces = []
    for camera, shift_px in ((calibration.left, 0), (calibration.right, _DISPARITY_PX)):
        behind_px, _ = _crossing_px(camera.width, camera.height, shift_px)
        surfaces.append((behind_px / _SPEED_PX_S * NS_PER_S / unit_ns).astype(np.uint16) + np.uint16(1))
    left, right = surfaces
    age = left[y, x].astype(np.uint32) * np.uint32(unit_ns)
    both = [np.stack([np.zeros_like(surface), surface]) for surface in surfaces]
    ones = np.ones(len(x), np.uint8)
    yield StereoBatch(0, NS_PER_S, NS_PER_S - _BATCH_NS, unit_ns, x, y, age, ones, both[0], both[1], left, right)


def _estimates(calibration: Calibration) -> Iterator[Message]:
    """What a rig that slides sideways past points at several depths gives the optimizer."""
    from velod.geometry.camera import motion_field_rows
    from velod.geometry.rectify import rectified_pair

    rect = rectified_pair(calibration)
    rng = np.random.default_rng(0)
    n = 80
    for k in range(int(_SECONDS * NS_PER_S) // _BATCH_NS):
        t_ns = (k + 1) * _BATCH_NS
        x, y = rng.uniform(20, rect.width - 20, n), rng.uniform(20, rect.height - 20, n)
        angle = rng.uniform(0.0, 2.0 * np.pi, n)
        normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        inv_depth = rng.uniform(0.25, 1.0, n)
        nA, _ = motion_field_rows(x, y, rect.f, rect.cx, rect.cy, normal)
        signed = (nA @ (rect.R_CB @ np.array([1.0, 0.2, 0.1]))) * inv_depth
        normal *= np.where(signed < 0.0, -1.0, 1.0)[:, None]
        index = np.arange(n, dtype=np.uint16)
        f32 = np.float32
        yield FlowBatch(
            seq=k,
            t_ns=t_ns,
            n_selected=n,
            index=index,
            age=rng.integers(1, _BATCH_NS, n).astype(np.uint32),
            x=x.astype(f32),
            y=y.astype(f32),
            n=normal.astype(f32),
            speed=(np.abs(signed) + 0.1).astype(f32),
            sigma=np.full(n, 2.0, f32),
        )
        yield DepthBatch(
            seq=k,
            t_ns=t_ns,
            n_selected=n,
            index=index,
            disparity=(inv_depth * rect.f * rect.baseline_m).astype(f32),
            inv_depth=inv_depth.astype(f32),
            sigma=np.full(n, 0.01, f32),
            refined=np.ones(n, np.uint8),
        )
        sample_t_ns = np.arange(t_ns - _BATCH_NS, t_ns, _IMU_NS, dtype=np.int64) + _IMU_NS
        accel = np.tile(_SPECIFIC_FORCE, (len(sample_t_ns), 1))
        yield ImuSamples(k, t_ns, t_ns, k, t_ns, sample_t_ns, accel, np.zeros((len(sample_t_ns), 3)))
