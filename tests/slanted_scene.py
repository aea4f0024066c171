"""A recording in closed form, of any length and light to process: slanted edges that slide past a stereo rig."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from velod.geometry.calibration import Calibration, Camera
from velod.io.model import EventColumns, Imu, SequenceData, Truth
from velod.io.sequence import write_recording

CAMERA = Camera(width=240, height=180, fx=200.0, fy=200.0, cx=119.5, cy=89.5)
RIG = Calibration(left=CAMERA, right=CAMERA, R_RL=np.eye(3), t_RL=np.array([-0.1, 0.0, 0.0]))
SPEED_PX_S, SPACING_PX, SLANT, DISPARITY_PX = 250.0, 64.0, 0.5, 8
V_B = np.array([-SPEED_PX_S * 0.1 / DISPARITY_PX, 0.0, 0.0])
"""The edges run to the right at Z = f b / disparity, so the rig moves to the left."""


def events(seconds: float, shift_px: int, seed: int) -> EventColumns:
    """Every passage of an edge over a pixel is one ON event; edges lean one way above the middle, the other below."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float64)
    lean = np.where(y < CAMERA.height / 2, SLANT, -SLANT) * y
    first_s = np.mod(x + shift_px - lean, SPACING_PX) / SPEED_PX_S
    passages = int(np.ceil(seconds * SPEED_PX_S / SPACING_PX))
    t_s = first_s[..., None] + np.arange(passages) * (SPACING_PX / SPEED_PX_S)
    t_us = np.round((t_s + np.random.default_rng(seed).normal(0.0, 5e-5, t_s.shape)) * 1e6).astype(np.int64)
    kept = (t_us > 0) & (t_us < seconds * 1e6)
    row, column, _ = np.nonzero(kept)
    order = np.argsort(t_us[kept], kind="stable")
    return EventColumns(
        t_ns=t_us[kept][order] * 1000,
        x=column[order].astype(np.uint16),
        y=row[order].astype(np.uint16),
        p=np.ones(len(order), np.uint8),
    )


def imu(seconds: float) -> Imu:
    """200 Hz, level and without rotation, with the noise of the settings."""
    rng = np.random.default_rng(3)
    t_ns = np.arange(0, int(seconds * 1e9), 5_000_000, dtype=np.int64)
    accel = np.array([0.0, -9.81, 0.0]) + rng.normal(0.0, 1.86e-2 * 200**0.5, (len(t_ns), 3))
    return Imu(t_ns, accel, rng.normal(0.0, 1.86e-3 * 200**0.5, (len(t_ns), 3)))


def write(path: Path, seconds: float) -> Path:
    """The recording as a sequence file."""
    samples = imu(seconds)
    n = len(samples.t_ns)
    still = np.zeros((n, 3))
    # Body y down, world z up.
    level = np.tile([-(0.5**0.5), 0.0, 0.0, 0.5**0.5], (n, 1))
    truth = Truth(samples.t_ns, np.tile(V_B, (n, 1)), still, level)
    data = SequenceData(RIG, events(seconds, 0, 1), events(seconds, DISPARITY_PX, 2), samples, truth)
    write_recording(path, data)
    return path
