"""What flow, depth and IMU say of the calibration: faults raise an alarm where they can be seen, and only then."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests import synthetic
from velod.config import ImuSettings, OptimizerSettings, Settings
from velod.depth.stage import DepthStage
from velod.flow.stage import FlowStage
from velod.geometry.calibration import Calibration
from velod.geometry.rectify import rectify
from velod.ingest.stage import IngestStage
from velod.io import open_recording
from velod.optimizer.calibration_check import CLOCK, EVERY, ROWS, SCALE, CalibrationCheck
from velod.optimizer.scale_check import SPAN_S, ScaleCheck, noise_of_span
from velod.optimizer.stage import OptimizerStage
from velod.optimizer.stereo_check import (
    MIN_BATCHES,
    MIN_PAIRS,
    MOTION_OUTLIER,
    MOTION_ROUNDS,
    MOTION_SHARE,
    NEAR_PX,
    StereoCheck,
    _fit_motion,
    _neighbours,
    _robust_sums,
)
from velod.types import F64, DepthBatch, EventBatch, EventPacket, FlowBatch, StereoBatch

CAMERA = (260.0, 173.0, 130.0)
DATA = Path(__file__).parents[3] / "shared" / "data"


# --- rows and clocks, on edges in closed form


def stereo_edges(
    seq: int, flow_px_s: np.ndarray, clock_s: float, row_px: float, parallax_hz: float = 0.0, slant: float = 0.02
) -> tuple[FlowBatch, DepthBatch]:
    """Short edges that lean every way, on a slanted wall that moves by ``flow_px_s``, and sideways in space besides.

    ``parallax_hz``: that motion over the disparity. ``slant``: slope of the disparity along a row.

    Each is matched where, at the left event's time by the right clock, it crosses the row in the right image.
    """
    rng = np.random.default_rng(seq)
    m = 300
    at = rng.uniform([20.0, 20.0], [320.0, 240.0], (m, 2))
    angle = rng.uniform(-1.2, 1.2, m)
    n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    true_px = 15.0 + slant * at[:, 0] + 0.01 * at[:, 1]
    motion = flow_px_s + parallax_hz * np.stack([true_px, np.zeros(m)], axis=1)
    n *= np.sign(np.sum(n * motion, axis=1))[:, None]
    speed = np.sum(n * motion, axis=1)
    # The right image shows the edge as it was clock_s ago, row_px lower: it is the line n . (p - p0) = 0.
    p0 = at - np.stack([true_px, np.zeros(m)], axis=1) - motion * clock_s + [0.0, row_px]
    crossing_x = p0[:, 0] - n[:, 1] / n[:, 0] * (at[:, 1] - p0[:, 1])
    f32 = np.float32
    disparity = at[:, 0] - crossing_x + rng.normal(0.0, 0.05, m) / np.abs(n[:, 0])
    measured = speed * (1.0 + rng.normal(0.0, 0.02, m))
    index = np.arange(m, dtype=np.uint16)
    x, y = at.astype(f32).T
    flow = FlowBatch(
        seq, 10 * seq, m, index, np.ones(m, np.uint32), x, y, n.astype(f32),
        measured.astype(f32), (0.02 * speed + 0.1).astype(f32),
    )  # fmt: skip
    ones = np.ones(m, np.uint8)
    return flow, DepthBatch(seq, 10 * seq, m, index, disparity.astype(f32), ones.astype(f32), ones.astype(f32), ones)


def seen(clock_s: float, row_px: float, flows: list[tuple[float, float]]) -> StereoCheck:
    check = StereoCheck(CAMERA)
    for seq in range(2 * MIN_BATCHES):
        check.add(*stereo_edges(seq, np.array(flows[seq % len(flows)]), clock_s, row_px))
    return check


@pytest.mark.parametrize(("clock_s", "row_px"), [(0.0, 0.0), (0.003, 0.0), (-0.001, 0.3), (0.0, -1.0)])
def test_clock_and_rows_are_told_apart_by_motion_that_varies(clock_s: float, row_px: float) -> None:
    offsets = seen(clock_s, row_px, [(300.0, 200.0), (-250.0, 120.0), (200.0, -260.0)]).offsets()
    assert offsets is not None
    assert abs(offsets.clock_s - clock_s) < max(4 * offsets.clock_sigma_s, 0.05 * abs(clock_s) + 2e-5)
    assert abs(offsets.row_px - row_px) < max(4 * offsets.row_sigma_px, 0.05 * abs(row_px) + 0.01)
    assert offsets.clock_sigma_s < 2e-4
    assert offsets.row_sigma_px < 0.05


def test_a_slide_along_the_rows_says_nothing_of_the_clocks_but_all_of_the_rows() -> None:
    offsets = seen(0.003, 0.5, [(300.0, 0.0)]).offsets()
    assert offsets is not None
    assert offsets.clock_sigma_s == math.inf
    assert offsets.row_px == pytest.approx(0.5, abs=0.05)


def test_what_is_nearer_is_faster_as_well_and_passes_for_no_clock() -> None:
    check = StereoCheck(CAMERA)
    for seq in range(2 * MIN_BATCHES):
        motion = np.array([-100.0, (-80.0, 90.0)[seq % 2]])
        check.add(*stereo_edges(seq, motion, 0.0, 0.0, parallax_hz=12.0, slant=0.12))
    offsets = check.offsets()
    assert offsets is not None
    assert abs(offsets.clock_s) < 2e-4
    assert offsets.clock_sigma_s < 3e-4


def test_few_batches_say_nothing() -> None:
    check = StereoCheck(CAMERA)
    for seq in range(MIN_BATCHES - 1):
        check.add(*stereo_edges(seq, np.array([300.0, 200.0]), 0.003, 0.0))
    assert check.offsets() is None


def test_the_kernels_are_their_plain_twins() -> None:
    flow, depth = stereo_edges(1, np.array([200.0, 150.0]), 0.002, 0.4)
    x, y, n = flow.x.astype(float), flow.y.astype(float), flow.n.astype(float)
    u, d = flow.speed / n[:, 0], depth.disparity.astype(float)
    per_px, root = 0.3 * u / d, np.random.default_rng(1).normal(0.0, 1.0, (len(x), 6))
    rows = np.empty((4096, 5))
    rows = rows[: _neighbours(x, y, n, d, per_px, 0.7 * u, root, rows)]
    i, j = np.tril_indices(len(x), -1)
    near = (np.abs(x[i] - x[j]) < NEAR_PX) & (np.abs(y[i] - y[j]) < NEAR_PX)
    i, j, lean = i[near], j[near], n[:, 1] / n[:, 0]
    shape = np.hypot(1.0 / n[i, 0], 1.0 / n[j, 0])
    at_one_depth = 0.7 * (u[i] - u[j]) + (d[i] + d[j]) / 2 * (per_px[i] - per_px[j])
    noise2 = np.sum((root[i] - root[j]) ** 2, axis=1) + (MOTION_SHARE * (0.7 * u[i] + d[i] * per_px[i])) ** 2
    twin = np.stack([d[i] - d[j], at_one_depth, lean[j] - lean[i], shape, noise2], axis=1)
    np.testing.assert_allclose(rows, twin, rtol=1e-12, atol=1e-12)

    H, h, solution = np.zeros((2, 2)), np.zeros(2), np.zeros(2)
    noise, weight = _robust_sums(rows, H, h)
    for _ in range(5):
        size = np.abs(twin[:, 0] - twin[:, 1:3] @ solution) / shape
        scale = 2.0 * np.median(size)
        w = 1.0 / (1.0 + (size / scale) ** 2) / (shape * scale) ** 2
        H_twin, h_twin = (twin[:, 1:3] * w[:, None]).T @ twin[:, 1:3], twin[:, 1:3].T @ (w * twin[:, 0])
        solution = np.linalg.solve(H_twin, h_twin)
    np.testing.assert_allclose(H, H_twin, rtol=1e-9)
    np.testing.assert_allclose(h, h_twin, rtol=1e-9, atol=1e-9)
    assert noise == pytest.approx(float(w @ twin[:, 4]))
    assert weight == pytest.approx(float(w.sum()))


def test_the_motion_is_that_of_least_squares_by_lapack_with_its_covariance_and_without_the_outliers() -> None:
    rng = np.random.default_rng(2)
    rows, sigma = rng.normal(size=(200, 6)) * [30.0, 20.0, 1.0, 300.0, 200.0, 50.0], rng.uniform(5.0, 20.0, 200)
    speed = rows @ [1.0, -0.5, 2.0, 0.1, 0.3, -0.2] + sigma * rng.normal(size=200)
    speed[:30] += 300.0
    fit = _fit_motion(rows, speed, sigma)
    assert fit is not None
    kept = np.ones(200, bool)
    for _ in range(MOTION_ROUNDS):
        weighted = rows[kept] / sigma[kept, None]
        twin = np.linalg.lstsq(weighted, speed[kept] / sigma[kept], rcond=None)[0]
        off = np.abs(speed - rows @ twin) / sigma
        scale = max(1.0, 1.5 * float(np.median(off)))
        kept = off < MOTION_OUTLIER * scale
    assert not kept[:30].any()
    np.testing.assert_allclose(fit[0], twin, rtol=1e-9)
    np.testing.assert_allclose(fit[1] @ fit[1].T, scale**2 * np.linalg.inv(weighted.T @ weighted), rtol=1e-9)


@pytest.mark.parametrize("missing", ["flows", "a direction", "a combination"])
def test_no_motion_where_the_flows_do_not_determine_it(missing: str) -> None:
    rows = np.random.default_rng(3).normal(size=(MIN_PAIRS - 1 if missing == "flows" else 200, 6))
    if missing == "a direction":
        rows[:, 4] = 0.0
    elif missing == "a combination":
        rows[:, 4] = 2.0 * rows[:, 1] - rows[:, 5]
    assert _fit_motion(rows, rows.sum(axis=1), np.ones(len(rows))) is None


# --- on recordings that velod did not make


def camera_of(calibration: Calibration) -> tuple[float, float, float]:
    rect = rectify(calibration)
    return rect.f, rect.cx, rect.cy


def front_end(path: Path, late_ns: int = 0, calibration: Calibration | None = None) -> CalibrationCheck:
    """The check over a whole recording, whose right camera is ``late_ns`` late."""
    recording = open_recording(path, calibration=calibration)
    ingest, flow, depth = (s(Settings(), recording.calibration) for s in (IngestStage, FlowStage, DepthStage))
    check = CalibrationCheck(OptimizerSettings(), ImuSettings(), camera_of(recording.calibration))
    flows: list[FlowBatch] = []
    depths: list[DepthBatch] = []
    for packet in recording.packets():
        if late_ns and isinstance(packet, EventPacket) and packet.camera == "right":
            packet = replace(packet, t_ns=packet.t_ns + late_ns, event_t_ns=packet.event_t_ns + late_ns)
        for message in ingest.handle(packet):
            if isinstance(message, EventBatch) and message.seq % EVERY == 0:
                flows += flow.handle(message)
            elif isinstance(message, StereoBatch) and message.seq % EVERY == 0:
                depths += depth.handle(message)
    for pair in zip(flows, depths, strict=True):
        for _ in range(EVERY):
            check.add_batch(*pair)
    return check


@pytest.mark.data
@pytest.mark.skipif(not DATA.is_dir(), reason="no recordings in ../shared/data")
@pytest.mark.parametrize("name", ["boxes_esim.h5", "boxes_v2e.h5", "slider_pseudo_stereo.h5"])
def test_recordings_with_a_right_calibration_raise_no_alarm(name: str) -> None:
    check = front_end(DATA / name)
    assert check.alarms == {}
    assert abs(check.gauges["calibration.rows_px"]) < 0.3
    if "slider" in name:
        assert "calibration.clock_ms" not in check.gauges, "a slide along the rows does not show it"
    else:
        assert abs(check.gauges["calibration.clock_ms"]) < 0.3


@pytest.mark.data
@pytest.mark.skipif(not DATA.is_dir(), reason="no recordings in ../shared/data")
@pytest.mark.parametrize("name", ["boxes_esim.h5", "boxes_v2e.h5"])
def test_a_right_camera_that_is_3_ms_late_raises_an_alarm(name: str) -> None:
    check = front_end(DATA / name, late_ns=3_000_000)
    assert "late" in check.alarms[CLOCK]
    assert 2.0 < check.gauges["calibration.clock_ms"] < 4.0


@pytest.mark.data
@pytest.mark.skipif(not DATA.is_dir(), reason="no recordings in ../shared/data")
def test_a_principal_point_that_is_a_pixel_off_raises_an_alarm() -> None:
    calibration = open_recording(DATA / "boxes_esim.h5").calibration
    wrong = replace(calibration, right=replace(calibration.right, cy=calibration.right.cy - 1.0))
    check = front_end(DATA / "boxes_esim.h5", calibration=wrong)
    assert "low" in check.alarms[ROWS]
    assert check.gauges["calibration.rows_px"] == pytest.approx(1.0, abs=0.3)


# --- scale


def scale_of(error: float, bend_m_s: float, seconds: float = 20.0) -> ScaleCheck:
    """Velocities that swing by ``bend_m_s``, gravity's line in their integral, and noise on the batches."""
    rng = np.random.default_rng(3)
    check = ScaleCheck(ImuSettings())
    for t in np.arange(0.0, seconds, 0.02):
        v = np.array([3.0, 0.5, 1.0]) + bend_m_s * np.sin(np.array([2.0, 2.7, 1.3]) * t)
        s_L = v + np.array([0.4, 9.7, 1.0]) * t + 7.0
        check.add(int(t * 1e9), s_L, (1.0 + error) * v - s_L + rng.normal(0.0, 0.05, 3))
    return check


@pytest.mark.parametrize("error", [-0.03, 0.0, 0.01])
def test_the_scale_is_seen_where_the_velocity_swings(error: float) -> None:
    scale = scale_of(error, bend_m_s=1.0).scale()
    assert scale is not None
    assert scale.sigma < 0.004
    assert abs(scale.error - error) < 4 * scale.sigma


def test_uniform_motion_says_little_of_the_scale() -> None:
    scale = scale_of(0.03, bend_m_s=0.0).scale()
    assert scale is not None
    assert scale.sigma > 0.1 or abs(scale.error) < 3 * scale.sigma


def integrated_noise(rng: np.random.Generator, imu: ImuSettings, n: int, period_s: float) -> F64:
    """s_L (n, 3) of an IMU that moves evenly: its accelerometer's noise, and gravity along a tilt that walks."""
    accel, gyro = (
        rng.normal(0.0, density / np.sqrt(period_s), (n, 3)) for density in (imu.accel_noise, imu.gyro_noise)
    )
    tilt = np.cumsum(gyro, axis=0)[:, [1, 0, 2]] * period_s
    return np.cumsum(accel + imu.gravity * tilt * [1.0, -1.0, 0.0], axis=0) * period_s


def test_the_noise_of_the_imu_alone_swings_as_much_as_is_reckoned_with() -> None:
    rng, found = np.random.default_rng(5), []
    t = np.arange(0.0, SPAN_S, 0.01)
    for _ in range(400):
        s = integrated_noise(rng, ImuSettings(accel_bias_walk=1e-9), len(t), 0.01)
        line = np.polynomial.polynomial.polyfit(t, s, 1)
        found.append(((s - np.polynomial.polynomial.polyval(t, line).T) ** 2).sum(axis=1).mean())
    assert np.mean(found) == pytest.approx(noise_of_span(ImuSettings(accel_bias_walk=1e-9)), rel=0.1)


@pytest.mark.parametrize("share", [0.1, 1.0])
def test_even_motion_under_an_imu_as_noisy_as_it_says_or_less_is_no_wrong_baseline(share: float) -> None:
    imu, rng = ImuSettings(), np.random.default_rng(4)
    quieter = replace(imu, accel_noise=share * imu.accel_noise, gyro_noise=share * imu.gyro_noise)
    check = ScaleCheck(imu)
    for k, s_L in enumerate(integrated_noise(rng, quieter, 2000, 0.02)):
        check.add(20_000_000 * k, s_L, np.array([1.25, 0.0, 0.0]) - s_L + rng.normal(0.0, 0.01, 3))
    scale = check.scale()
    assert scale is not None
    assert abs(scale.error) < 3 * scale.sigma


def test_a_hole_or_a_new_count_of_the_integral_begins_a_new_span() -> None:
    check = ScaleCheck(ImuSettings())
    for k in range(int(3 * SPAN_S / 0.02)):
        jump = 100.0 * (k // 60)
        check.add(20_000_000 * k, np.full(3, jump), np.zeros(3))
    assert check.scale() is None


@pytest.mark.parametrize(("baseline", "alarm"), [(1.0, False), (1.03, True)])
def test_a_baseline_that_is_3_percent_wrong_raises_an_alarm_within_16_s(baseline: float, alarm: bool) -> None:
    calibration = replace(synthetic.CALIBRATION, t_RL=synthetic.CALIBRATION.t_RL * baseline)
    stage = OptimizerStage(Settings(), calibration)
    for message in synthetic.messages(synthetic.FLIGHT, 16.0, flows=60, period_s=0.03):
        if isinstance(message, DepthBatch):
            depth = (message.inv_depth / np.float32(baseline), message.sigma / np.float32(baseline))
            message = replace(message, inv_depth=depth[0], sigma=depth[1])
        stage.handle(message)
    assert (SCALE in stage.alarms) == alarm
    sigma = stage.gauges["calibration.scale_sigma_percent"]
    assert sigma < 0.8
    assert abs(stage.gauges["calibration.scale_percent"] - 100.0 * (baseline - 1.0)) < 4 * sigma
