"""Disparities of the ingest and depth stages against the true depth of recordings that velod did not make."""

from pathlib import Path

import numpy as np
import pytest

from velod.config import Settings
from velod.depth.stage import DepthStage
from velod.geometry.rectify import rectify
from velod.ingest.stage import IngestStage
from velod.io.recording import open_recording
from velod.io.sequence import read_depth
from velod.types import DepthBatch, StereoBatch

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
pytestmark = [pytest.mark.data, pytest.mark.skipif(not DATA.is_dir(), reason="no recordings in ../shared/data")]


def batches(path: Path, seconds: float) -> list[tuple[StereoBatch, DepthBatch]]:
    recording = open_recording(path)
    ingest = IngestStage(Settings(), recording.calibration)
    depth = DepthStage(Settings(), recording.calibration)
    out = []
    for packet in recording.packets():
        if packet.t_ns > recording.t_start_ns + int(seconds * 1e9):
            return out
        for message in ingest.handle(packet):
            if isinstance(message, StereoBatch):
                out += [(message, estimate) for estimate in depth.handle(message)]
    return out


@pytest.mark.parametrize(("name", "mad_px"), [("boxes_esim.h5", 0.06), ("boxes_v2e.h5", 0.08)])
def test_disparity_against_true_depth(name: str, mad_px: float) -> None:
    """Points within 1.5 ms of a true depth image, away from depth edges."""
    truth = read_depth(DATA / name)
    assert truth is not None
    rect = rectify(open_recording(DATA / name).calibration)
    assert rect.identity, "sensor pixels index the true depth"
    error, sigma, refined = [], [], []
    found = selected = 0
    for message, estimate in batches(DATA / name, 1.2):
        selected, found = selected + len(message.x), found + len(estimate.index)
        for k, i in enumerate(estimate.index):
            x, y, t = int(message.x[i]), int(message.y[i]), message.t_ns - int(message.age[i])
            nearest = int(np.argmin(np.abs(truth.t_ns - t)))
            true_px = rect.f * rect.baseline_m / truth.left[nearest, y - 3 : y + 4, x - 3 : x + 4]
            if abs(int(truth.t_ns[nearest]) - t) < 1_500_000 and np.ptp(true_px) < 0.5:
                error.append(estimate.disparity[k] - true_px[3, 3])
                sigma.append(estimate.sigma[k] * rect.f * rect.baseline_m)
                refined.append(estimate.refined[k] == 1)
    e, z, r = np.array(error), np.array(error) / np.array(sigma), np.array(refined)
    assert found > 0.7 * selected  # measured 0.78: unconfirmed matches are dropped
    assert r.sum() > 100
    assert abs(np.median(e[r])) < 0.02
    assert np.median(np.abs(e[r] - np.median(e[r]))) < mad_px
    assert np.mean(np.abs(e) > 2.0) < 0.01
    assert 0.8 < np.std(z[np.abs(z) < 4.0]) < 1.3


def test_real_events_of_a_slider_give_the_scenes_depths() -> None:
    """Nothing in the scene is nearer than 0.6 m (the far end of the search), and the far wall is at about 2 m."""
    results = batches(DATA / "slider_pseudo_stereo.h5", 1.4)
    depths = np.concatenate([1.0 / estimate.inv_depth[estimate.refined == 1] for _, estimate in results])
    assert len(depths) > 3000
    assert 0.65 < np.percentile(depths, 5) < np.percentile(depths, 95) < 3.0
