"""The flow stage: speed and direction of known edges, lenses, gates, sigma, and batches that cannot be read."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.moving_edges import FOCAL, HEIGHT, WIDTH, calibration
from velod.config import Settings, from_tree
from velod.flow.stage import FlowStage
from velod.geometry.camera import undistort
from velod.types import EventBatch, FlowBatch

DX, DY = (a.ravel() for a in np.meshgrid(np.arange(-2, 3), np.arange(-2, 3)))
T_NS = 2_000_000_000
EVENT_AGE_NS = 30_000_000


def batch(
    speed: np.ndarray, angle: np.ndarray, x: int | np.ndarray = 30, y: int | np.ndarray = 20, noise_px: float = 0.0
) -> EventBatch:
    """One event per speed (px/s) and angle (of the motion, rad), in sensor pixels; noise of the neighbours' times."""
    speed, angle = np.atleast_1d(speed).astype(float), np.atleast_1d(angle).astype(float)
    along = np.cos(angle)[:, None] * DX + np.sin(angle)[:, None] * DY
    along = along + np.random.default_rng(1).normal(0, noise_px, along.shape)
    patch = np.round(EVENT_AGE_NS - along / speed[:, None] * 1e9).astype(np.uint32)
    n = len(patch)
    at = [np.broadcast_to(np.asarray(v, np.uint16), n).copy() for v in (x, y)]
    return EventBatch(7, T_NS, T_NS - 10_000_000, 500, *at, patch[:, 12].copy(), np.ones(n, np.uint8), patch)


def flows(message: EventBatch, stage: FlowStage | None = None, **flow: object) -> FlowBatch:
    stage = stage or FlowStage(from_tree({"flow": flow}), calibration())
    (out,) = stage.handle(message)
    return out


def test_speed_and_direction_of_an_edge_are_recovered() -> None:
    angle = np.linspace(-math.pi, math.pi, 33)
    out = flows(batch(np.full(33, 300.0), angle))
    assert np.array_equal(out.index, np.arange(33))
    assert out.speed == pytest.approx(300.0, rel=1e-6)
    assert out.n == pytest.approx(np.column_stack([np.cos(angle), np.sin(angle)]), abs=1e-6)


def test_a_flow_keeps_its_events_position_age_and_batch() -> None:
    message = batch([300.0, 200.0], [0.1, 0.2], x=np.array([30, 11]), y=np.array([20, 12]))
    out = flows(message)
    assert (out.seq, out.t_ns, out.n_selected) == (7, T_NS, 2)
    assert out.age.tolist() == [EVENT_AGE_NS, EVENT_AGE_NS]
    assert out.x.tolist() == [30.0, 11.0] and out.y.tolist() == [20.0, 12.0]


def test_the_reciprocal_of_each_component_is_the_wrong_baseline() -> None:
    message = batch(np.full(2, 300.0), np.array([0.0, math.pi / 4]))
    out = flows(message, method="benosman")
    # Right along the diagonal only by a factor of two: 1/gx = 300 / cos(45 deg) on each axis.
    assert out.speed[-1] == pytest.approx(600.0, rel=1e-5)
    assert flows(message).speed[-1] == pytest.approx(300.0, rel=1e-5)


def test_through_a_lens_the_flow_is_that_of_the_undistorted_image() -> None:
    rig = calibration("radtan", (-0.3, 0.1, 0.001, -0.002, 0.0))
    stage = FlowStage(Settings(), rig)
    rectified = stage.rectification
    x, y = np.array([8, 50, 30]), np.array([10, 36, 6])
    angle = np.array([0.3, 2.0, -1.0])
    out = flows(batch(np.full(3, 300.0), angle, x, y), stage)

    def rectify(px: np.ndarray) -> np.ndarray:
        centre = [WIDTH / 2, HEIGHT / 2]
        return undistort((px - centre) / FOCAL, rig.left) * rectified.f + [rectified.cx, rectified.cy]

    px, step = np.column_stack([x, y]).astype(float), 1e-3
    edge = np.column_stack([-np.sin(angle), np.cos(angle)])
    tangent = rectify(px + step * edge) - rectify(px - step * edge)
    normal = np.column_stack([tangent[:, 1], -tangent[:, 0]]) / np.linalg.norm(tangent, axis=1)[:, None]
    u = (
        rectify(px + step * normal * 0 + step * np.column_stack([np.cos(angle), np.sin(angle)])) - rectify(px)
    ) / step
    speed = (u * normal).sum(axis=1) * 300.0
    assert np.column_stack([out.x, out.y]) == pytest.approx(rectify(px), abs=1e-3)
    assert out.n == pytest.approx(normal, abs=2e-3)
    assert out.speed == pytest.approx(speed, rel=3e-3)
    assert np.abs(speed / 300.0 - 1).max() > 0.05


def test_sigma_is_the_scatter_of_noisy_fits() -> None:
    rng = np.random.default_rng(3)
    n = 2000
    out = flows(batch(np.full(n, 300.0), rng.uniform(-math.pi, math.pi, n), noise_px=0.15))
    z = (out.speed - 300.0) / out.sigma
    assert 0.5 < z.std() < 1.2
    assert out.sigma.min() > 0.006 * 300.0


def test_what_fits_no_plane_is_refused_by_cause() -> None:
    message = batch(np.full(4, 300.0), np.zeros(4))
    message.patch[1, :10] = 0
    checkerboard_px = 0.45 * (-1.0) ** (DX + DY)
    message.patch[2] = np.round(EVENT_AGE_NS - (DX + checkerboard_px) / 300.0 * 1e9)
    too_fast = batch(np.full(1, 30_000.0), np.zeros(1))
    message.patch[3] = too_fast.patch[0]
    stage = FlowStage(Settings(), calibration())
    out = flows(message, stage)
    assert out.index.tolist() == [0]
    assert stage.counters["flow.unfit"] == 1
    assert stage.counters["flow.rms"] == 1
    assert stage.counters["flow.speed"] == 1


def test_an_empty_batch_gives_an_empty_one() -> None:
    out = flows(batch(np.empty(0), np.empty(0)))
    assert (out.n_selected, len(out.index), out.n.shape, out.speed.dtype) == (0, 0, (0, 2), np.float32)


@pytest.mark.parametrize(
    "change",
    [
        {"x": np.full(3, WIDTH, np.uint16)},
        {"y": np.full(3, HEIGHT, np.uint16)},
        {"age": np.ones(2, np.uint32)},
        {"patch": np.ones((3, 24), np.uint32)},
    ],
)
def test_a_batch_that_cannot_be_read_is_counted_and_dropped(change: dict[str, np.ndarray]) -> None:
    stage = FlowStage(Settings(), calibration())
    assert stage.handle(replace(batch(np.full(3, 300.0), np.zeros(3)), **change)) == []
    assert stage.counters["batches.malformed"] == 1


def test_columns_may_be_read_only_as_they_come_from_the_wire() -> None:
    message = batch([300.0, 200.0], [0.1, 0.2])
    expected = flows(message)
    for column in (message.x, message.y, message.age, message.p, message.patch):
        column.flags.writeable = False
    assert np.array_equal(flows(message).speed, expected.speed)
