"""Scenes that invite wrong answers: what comes of them is rejected, or carries a sigma that owns up to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.moving_edge import PLAIN_RIG, Edge, batch, stereo_batch, surface
from velod.config import Settings
from velod.depth import stage as module
from velod.depth.stage import DepthStage
from velod.geometry.rectify import rectify
from velod.optimizer.batch_fit import solve_weighted
from velod.optimizer.flow_equation import Measured, body_rows, on_velocity
from velod.types import DepthBatch, StereoBatch

F_B = 20.0
"""f b of PLAIN_RIG, px m."""


def gross(out: DepthBatch, true_px: np.ndarray) -> np.ndarray:
    """(m,) which depths are off by more than 2 px and by more than four of their sigmas."""
    error = np.abs(out.disparity - true_px[out.index])
    return np.asarray((error > 2.0) & (error > 4.0 * out.sigma * F_B))


@pytest.mark.parametrize("period_px", [9.0, 10.7, 12.4])
def test_a_repetitive_texture_gives_no_confident_wrong_depth(
    period_px: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A grating of equal edges a period apart matches itself, left to right and back, at every period."""
    edges = [Edge(x_px=230.0 - k * period_px, angle=0.15, disparity_px=25.3) for k in range(24)]
    message = batch(*edges, points=300, jitter_s=0.1 / 300.0)
    true_px = np.full(len(message.x), 25.3)
    (out,) = DepthStage(Settings(), PLAIN_RIG).handle(message)
    assert gross(out, true_px).sum() <= 0.01 * len(message.x)
    # It is the rival match that tells: left and right agree on the wrong one.
    monkeypatch.setattr(module, "_RIVAL_SHARE", 2.0)
    (unchecked,) = DepthStage(Settings(), PLAIN_RIG).handle(message)
    assert gross(unchecked, true_px).sum() > 0.05 * len(message.x)


def half_occluded() -> tuple[StereoBatch, np.ndarray, np.ndarray]:
    """A near poster before a far wall; the batch, true disparities, and which points the right camera cannot see.

    The poster has disparity 20, left columns 110 to 159; the wall 6. Left columns 96 to 109 of the wall lie behind
    the poster in the right image. The rig moves along the row, so speeds are in proportion to disparities.
    """
    rng = np.random.default_rng(7)
    rect = rectify(PLAIN_RIG)
    near, far = (
        [
            Edge(x_px=x + rng.uniform(-3, 3), angle=rng.uniform(-0.5, 0.5), speed_px_s=20.0 * d, disparity_px=d)
            for x in np.arange(30.0, 290.0, 17.0)
        ]
        for d in (20.0, 6.0)
    )

    def seen(right: bool, xy: np.ndarray) -> np.ndarray:
        poster = (xy[..., 0] >= 110 - 20 * right) & (xy[..., 0] < 160 - 20 * right)
        layers = (surface(e, xy, right=right, jitter_s=0.0, seed=1) for e in (near, far))
        return np.where(poster, *layers)

    left, right = seen(False, rect.left_xy), seen(True, rect.right_xy)
    inside = np.zeros_like(left, bool)
    inside[25:-25, 60:-25] = True
    y, x = np.nonzero((left > 0) & inside)
    hidden_first = np.argsort(~((x >= 96) & (x < 110)), kind="stable")
    some = np.concatenate([rng.permutation(hidden_first[:1500])[:200], rng.permutation(hidden_first[1500:])[:400]])
    y, x = y[some], x[some]
    message = stereo_batch(left, right, x, y)
    return message, np.where((x >= 110) & (x < 160), 20.0, 6.0), (x >= 96) & (x < 110)


def test_what_only_one_camera_sees_gets_no_confident_depth() -> None:
    message, true_px, hidden = half_occluded()
    assert hidden.sum() >= 150
    (out,) = DepthStage(Settings(), PLAIN_RIG).handle(message)
    assert gross(out, true_px).sum() <= 0.01 * len(true_px)
    found = np.zeros(len(true_px), bool)
    found[out.index] = True
    # Half of the points are beside a jump or at an edge that has not passed their neighbourhood.
    assert found[hidden].mean() < 0.15 < 0.4 < found[~hidden].mean()


def outline_before(wall: list[Edge]) -> StereoBatch:
    """The ON outline of something near, disparity 20, before a wall of OFF edges."""
    message, rect = (
        batch(Edge(x_px=170.0, angle=0.1, speed_px_s=300.0, disparity_px=20.0), points=100),
        rectify(PLAIN_RIG),
    )
    off = [
        surface(wall, xy, right=right, jitter_s=0.0, seed=1)
        for right, xy in ((False, rect.left_xy), (True, rect.right_xy))
    ]
    left, right = (np.stack([o, both[1]]) for o, both in zip(off, (message.left, message.right), strict=True))
    return replace(message, left=left, right=right)


def test_an_outline_before_a_busy_background_owns_up_in_its_sigma() -> None:
    """It is found, and where; but what surrounds it is at another distance, and moves in another way."""
    wall = [Edge(x_px=60.0 + 5.0 * k, angle=0.4, speed_px_s=90.0, disparity_px=6.5) for k in range(40)]
    (busy,), (blank,) = (DepthStage(Settings(), PLAIN_RIG).handle(outline_before(w)) for w in (wall, []))
    for out in (busy, blank):
        assert len(out.index) > 60
        np.testing.assert_allclose(out.disparity, 20.0, atol=0.05)
    assert np.mean(busy.sigma * F_B > 5.0) > 0.8
    assert np.max(blank.sigma * F_B) < 0.1


def test_something_that_moves_by_itself_has_the_depth_at_which_it_is() -> None:
    """Its flow is another one; both cameras see it at the same time all the same."""
    still = [Edge(x_px=40.0 + 37.0 * k, angle=0.3, speed_px_s=120.0, disparity_px=6.0) for k in range(6)]
    own = Edge(x_px=150.0, angle=-0.4, speed_px_s=500.0, disparity_px=11.0)
    message = batch(*still, own, points=400)
    passed_s = 1e-9 * message.age
    moving = np.abs(passed_s - own.age_s(message.x.astype(float), message.y.astype(float))) < 1e-5
    (out,) = DepthStage(Settings(), PLAIN_RIG).handle(message)
    assert gross(out, np.where(moving, 11.0, 6.0)).sum() <= 0.01 * len(moving)
    # The others are where both kinds of edges cross.
    assert np.isin(np.flatnonzero(moving), out.index).sum() > 40


def test_an_object_that_moves_by_itself_has_no_weight_in_the_velocity() -> None:
    """A fifth of the flows are on an object that crosses the image: right as flows, wrong as witnesses."""
    rng = np.random.default_rng(3)
    m, v = 400, np.array([2.0, -0.5, 1.0])
    x, y = rng.uniform(10, 330, m).astype(np.float32), rng.uniform(10, 250, m).astype(np.float32)
    angle = rng.uniform(-np.pi, np.pi, m)
    n = np.column_stack([np.cos(angle), np.sin(angle)]).astype(np.float32)
    inverse = rng.uniform(0.15, 0.5, m)
    a, b = body_rows((x, y), n, inverse.astype(np.float32), (230.0, 172.0, 130.0), np.eye(3), np.zeros(3))
    moving = (x > 200) & (y > 60) & (y < 200)
    inverse_sigma = 0.01 * inverse
    own = np.where(moving[:, None], v + np.array([1.2, 0.4, -0.6]), v)
    speed = (a * own).sum(axis=1)
    a, b, speed = a * np.sign(speed)[:, None], b * np.sign(speed)[:, None], np.abs(speed)
    sigma = 0.02 * speed + 1.0
    rows = on_velocity(np.zeros(m, np.int64), speed + sigma * rng.normal(size=m), a, b, np.zeros((m, 3)))
    measured = Measured(speed, sigma, rows.z, inverse_sigma / inverse)
    fit = solve_weighted(rows, measured, 64, 1)
    assert fit is not None
    assert 0.15 < moving.mean() < 0.3
    off = np.abs((rows.a * (own - v)).sum(axis=1)) > 6.0 * rows.sigma
    assert off.sum() > 40  # the others move, along n, as the scene does
    assert fit.weight[off].mean() < 0.05
    assert fit.weight[~moving].mean() > 0.6
    assert np.linalg.norm(fit.e - v) < 0.05
