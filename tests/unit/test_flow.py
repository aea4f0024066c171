"""The flow stage: speed and direction of known edges, lenses, gates, sigma, and batches that cannot be read."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.moving_edges import FOCAL, HEIGHT, WIDTH, calibration
from velod.config import Settings, from_tree
from velod.events.plane_fit import fit_plane, honest_rms, widen_plane
from velod.flow.kernel import BEND_PX, INFLATION
from velod.flow.stage import FlowStage
from velod.geometry.camera import undistort
from velod.types import EventBatch, FlowBatch

DX, DY = (a.ravel() for a in np.meshgrid(np.arange(-2, 3), np.arange(-2, 3)))
WIDE_DX, WIDE_DY = (a.ravel() for a in np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)))
CORE = (np.abs(WIDE_DX) <= 2) & (np.abs(WIDE_DY) <= 2)
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


def wide_batch(speed: np.ndarray, angle: np.ndarray, x: np.ndarray, y: np.ndarray, noise_px: float) -> EventBatch:
    """As ``batch``, with the ring around the patches."""
    along = np.cos(angle)[:, None] * WIDE_DX + np.sin(angle)[:, None] * WIDE_DY
    along = along + np.random.default_rng(2).normal(0, noise_px, along.shape)
    ages = np.round(EVENT_AGE_NS - along / speed[:, None] * 1e9).astype(np.uint32)
    core = np.ascontiguousarray(ages[:, CORE])
    return replace(
        batch(speed, angle, x, y), patch=core, age=core[:, 12].copy(), ring=np.ascontiguousarray(ages[:, ~CORE])
    )


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
    # A residual far below the usual is luck.
    assert out.sigma.min() > 0.006 * 300.0


def across_motion(seed: int, n: int = 400) -> tuple[EventBatch, np.ndarray]:
    """Edges of all directions in an image that turns and grows; the batch and the motion (n, 2) at its events."""
    rng = np.random.default_rng(seed)
    x, y = rng.integers(5, WIDTH - 5, n), rng.integers(5, HEIGHT - 5, n)
    u = np.column_stack([300.0 - 4.0 * (y - 20) + 2.0 * (x - 30), 100.0 + 4.0 * (x - 30) + 2.0 * (y - 20)])
    angle = np.arctan2(u[:, 1], u[:, 0]) + rng.uniform(-1.3, 1.3, n)
    return wide_batch((u * np.column_stack([np.cos(angle), np.sin(angle)])).sum(axis=1), angle, x, y, 0.15), u


def test_an_edge_that_speeds_up_has_the_speed_that_it_has_at_the_event() -> None:
    """Two pixels on it is faster by a sixth: the mean slope over the 7x7 alone would be 1 to 2 % too slow."""
    angle = np.linspace(-math.pi, math.pi, 33)
    message = wide_batch(np.full(33, 150.0), angle, np.full(33, 30), np.full(33, 20), 0.0)
    along = np.cos(angle)[:, None] * WIDE_DX + np.sin(angle)[:, None] * WIDE_DY
    # Speed goes with the way, v + k s: t = log(1 + k s / v) / k.
    k = 0.08 * 150.0
    ages = np.round(EVENT_AGE_NS - np.log(1.0 + k * along / 150.0) / k * 1e9).astype(np.uint32)
    message = replace(message, patch=np.ascontiguousarray(ages[:, CORE]), ring=np.ascontiguousarray(ages[:, ~CORE]))
    share = flows(message).speed / 150.0 - 1.0
    assert np.abs(share).max() < 0.01


def test_the_ring_halves_the_scatter_of_flows() -> None:
    n = 2000
    message = wide_batch(np.full(n, 300.0), np.linspace(-3, 3, n), np.full(n, 30), np.full(n, 20), 0.15)
    wide, narrow = flows(message), flows(replace(message, ring=message.ring[:0]))
    assert len(wide.speed) == len(narrow.speed) == n
    assert wide.speed.std() < 0.6 * narrow.speed.std()


def test_sigma_is_honest_for_edges_at_all_angles_to_the_motion() -> None:
    message, u = across_motion(4)
    out = flows(message)
    true = (u[out.index] * out.n).sum(axis=1)
    along = np.abs((u[out.index] * out.n[:, ::-1] * [-1.0, 1.0]).sum(axis=1)) / true
    z = (out.speed - true) / out.sigma
    for steep in (along < 0.4, (along >= 0.4) & (along < 1.2), along >= 1.2):
        assert steep.sum() > 60
        # White residuals, and sigmas for those of real edges, which neighbours share.
        assert 0.6 < z[steep].std() < 1.0


def test_sigmas_agree_with_their_numpy_twin() -> None:
    message, _ = across_motion(5, 120)
    out = flows(message)
    x, y = message.x[out.index].astype(float), message.y[out.index].astype(float)
    nx, ny = out.n[:, 0].astype(float), out.n[:, 1].astype(float)
    cx, cy = (x - x.mean()) / 100.0, (y - y.mean()) / 100.0
    a = np.column_stack([nx, ny, nx * cx, ny * cx, nx * cy, ny * cy])
    b = out.speed.astype(float)
    u = np.linalg.solve(a.T @ a + np.eye(6), a.T @ b)
    ux, uy = u[0] + u[2] * cx + u[4] * cy, u[1] + u[3] * cx + u[5] * cy
    unknown = np.mean((b - a @ u) ** 2) + 6 * np.mean(b**2) / len(b)
    for k, i in enumerate(out.index):
        age = np.empty(49)
        age[CORE], age[~CORE] = message.patch[i] * 1e-9, message.ring[i] * 1e-9
        fit, bend, slope_rms = widen_plane(fit_plane(age[CORE], 1.0, 2, 20), age, 1.0, 0.35)
        n, gx, gy, _, _, qxx, qxy, qyy = fit
        q, normal = np.array([[qxx, qxy], [qxy, qyy]]), np.array([gx, gy]) / np.hypot(gx, gy)
        edge = np.array([-normal[1], normal[0]])
        share = INFLATION * honest_rms(n, slope_rms, np.hypot(gx, gy)) / np.hypot(gx, gy)
        along, turn = (share * np.sqrt(v @ q @ v) for v in (normal, edge))
        along = np.hypot(along, BEND_PX * bend / np.hypot(gx, gy))
        expected = np.sqrt((b[k] * along) ** 2 + turn**2 * ((edge @ [ux[k], uy[k]]) ** 2 + unknown))
        assert out.sigma[k] == pytest.approx(expected, rel=1e-4)


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
        {"ring": np.ones((3, 25), np.uint32)},
        {"ring": np.ones((2, 24), np.uint32)},
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
