"""Flow against the truth of a public simulator: bias, spread, gross outliers, and whether sigma is honest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from velod.config import Settings
from velod.flow.stage import FlowStage
from velod.geometry.calibration import Calibration, Camera
from velod.geometry.camera import motion_field_rows
from velod.ingest.stage import IngestStage
from velod.types import EventBatch, EventPacket

h5py = pytest.importorskip("h5py")
DATA = Path(__file__).parents[3] / "shared" / "data"
SECONDS = 0.41
NEAR_US = 5_000.0
"""Truth is looked up for events this close to a frame of true depth."""


def flows_near_depth(file: h5py.File) -> tuple[np.ndarray, ...]:
    """x, y, n, speed, sigma, event time (us) of the flows near depth frames, as ingest and flow give them."""
    c = file["calib"].attrs
    camera = Camera(int(c["width"]), int(c["height"]), c["fx"], c["fy"], c["cx"], c["cy"])
    rig = Calibration(camera, camera, np.eye(3), np.array([-c["baseline_m"], 0, 0]))
    ingest, flow = IngestStage(Settings(), rig), FlowStage(Settings(), rig)
    left = file["events/left"]
    end = int(np.searchsorted(left["t"][:], SECONDS * 1e6))
    x, y, t_us, p = (left[k][:end] for k in "xytp")
    nothing = np.empty(0, np.uint16)
    watermark = int(t_us[-1]) * 1000
    ingest.handle(
        EventPacket(0, watermark, "right", nothing, nothing, nothing.astype(np.int64), nothing.astype("u1"))
    )
    rows = []
    for batch in ingest.handle(EventPacket(0, watermark, "left", x, y, t_us * 1000, p)):
        if isinstance(batch, EventBatch):
            (f,) = flow.handle(batch)
            t = (batch.t_ns - f.age.astype(np.int64)) * 1e-3
            rows.append(np.column_stack([f.x, f.y, f.n, f.speed, f.sigma, t]))
    a = np.vstack(rows)
    away_us = np.abs(a[:, 6:] - file["depth/t_us"][:]).min(axis=1)
    a = a[(away_us < NEAR_US) & (a[:, 6] > 50_000)]
    return a[:, 0], a[:, 1], np.ascontiguousarray(a[:, 2:4]), a[:, 4], a[:, 5], a[:, 6]


def true_normal_flow(file: h5py.File, x: np.ndarray, y: np.ndarray, n: np.ndarray, t_us: np.ndarray) -> np.ndarray:
    """n^T u of Eq. 1 with true depth and motion; NaN beside steps of depth."""
    c = file["calib"].attrs
    frame = np.abs(t_us[:, None] - file["depth/t_us"][:]).argmin(axis=1)
    depth = file["depth/left"][:]
    h, w = depth.shape[1:]
    gt = file["gt/t_us"][:]
    v, omega = (
        np.column_stack([np.interp(t_us, gt, file[f"gt/{k}"][:, i]) for i in range(3)]) for k in ("v_B", "omega_B")
    )

    def flow_along(m: np.ndarray, Z: np.ndarray) -> np.ndarray:
        nA, nB = motion_field_rows(x, y, float(c["fx"]), float(c["cx"]), float(c["cy"]), m)
        return (nA * v).sum(axis=1) / Z + (nB * omega).sum(axis=1)

    # The depth of the event's point is found where that point is in the frame, a few ms away.
    dt = (file["depth/t_us"][:][frame] - t_us) * 1e-6
    Z = depth[frame, y.astype(int), x.astype(int)]
    axis = np.zeros((2, len(x), 2))
    axis[0, :, 0] = axis[1, :, 1] = 1.0
    for _ in range(3):
        px = [
            np.clip(np.rint(s + flow_along(m, Z) * dt).astype(int), 3, z - 4)
            for s, m, z in zip((x, y), axis, (w, h), strict=True)
        ]
        Z = depth[frame, px[1], px[0]] + v[:, 2] * dt
    around = np.stack([depth[frame, px[1] + j, px[0] + i] for i in range(-3, 4) for j in range(-3, 4)])
    return np.where(around.max(axis=0) / around.min(axis=0) < 1.06, flow_along(n, Z), np.nan)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "bias", "spread", "outliers"), [("boxes_esim", 0.005, 0.04, 0.007), ("boxes_v2e", 0.01, 0.045, 0.015)]
)
def test_flow_agrees_with_another_simulators_truth(name: str, bias: float, spread: float, outliers: float) -> None:
    path = DATA / f"{name}.h5"
    if not path.exists():
        pytest.skip(f"{path.name} is not in ../shared/data")
    with h5py.File(path) as file:
        x, y, n, speed, sigma, t_us = flows_near_depth(file)
        truth = true_normal_flow(file, x, y, n, t_us)
    known = np.isfinite(truth)
    speed, sigma, truth = speed[known], sigma[known], truth[known]
    assert len(truth) > 250
    error = speed / truth - 1
    low, median, high = np.percentile(error, [16, 50, 84])
    assert abs(median) < bias
    assert (high - low) / 2 < spread
    assert np.mean(np.abs(error) > 0.5) < outliers
    z = (speed - truth) / sigma
    assert 0.8 < z[np.abs(z) < 5].std() < 1.35
    assert np.mean(np.abs(z) > 5) < 0.02
