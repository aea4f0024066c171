"""The event model and the renderer against what can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from velod.geometry.calibration import Camera
from velod.io import EventColumns
from velod.sim.effects import Effects
from velod.sim.events import LOG_EPS, EventModel, EventSensor, _time_order
from velod.sim.render import Renderer
from velod.sim.scene import Scene, corridor, room
from velod.sim.shade import _atan2
from velod.sim.texture import SIZE, TEXEL_M, Texture, TextureRecipe, make_texture, sample
from velod.types import F32, F64

WIDTH, HEIGHT = 64, 4
EXACT = EventModel(threshold=0.5, threshold_sigma=0.0, refractory_us=0)
WHOLE = np.array([[0, HEIGHT, 0, WIDTH]])


def watch(model: EventModel, log_intensity: list[F64], t_us: list[int]) -> EventColumns:
    """Events of an image whose rows all show ``log_intensity`` (one row of WIDTH per moment)."""
    sensor = EventSensor(model, Effects(), WIDTH, HEIGHT, np.random.default_rng(0))
    views: list[F32] = [np.tile(np.exp(row) - LOG_EPS, (HEIGHT, 1)).astype(np.float32) for row in log_intensity]
    sensor.start(views[0])
    for view, before, now in zip(views[1:], t_us[:-1], t_us[1:], strict=True):
        sensor.see(view, WHOLE, np.array([before]), now)
    return sensor.take(t_us[0], t_us[-1])


def test_the_events_of_a_translating_edge_arrive_at_the_analytic_times() -> None:
    # A ramp of 1.6 in log intensity over 10 px moves at 500 px/s: it crosses -2 + 0.5 k at known places.
    speed, steps = 500.0, 1000 * np.arange(0, 100)
    x = np.arange(WIDTH)
    views = [np.interp(x - speed * t * 1e-6, [-10.0, 0.0], [-0.4, -2.0]) for t in steps]
    got = watch(EXACT, views, steps.tolist())
    expected = 0
    for k in (1, 2, 3):
        place_px = -10.0 * (0.5 * k / 1.6)
        arrival_s = (x - place_px) / speed
        expected += HEIGHT * int(np.sum(arrival_s * 1e6 <= steps[-1]))
        for column in (10, 20, 40):
            times = np.sort(got.t_ns[(got.x == column) & (got.y == 0)])
            # The ramp's ends are corners between views 1 ms apart.
            assert times[k - 1] / 1e9 == pytest.approx(arrival_s[column], abs=2e-6)
    assert set(got.p.tolist()) == {1}
    assert len(got.t_ns) == expected


def test_darkening_gives_off_events_and_brightening_on_events() -> None:
    down = watch(EXACT, [np.full(WIDTH, -1.0), np.full(WIDTH, -2.2)], [0, 1000])
    up = watch(EXACT, [np.full(WIDTH, -2.2), np.full(WIDTH, -1.0)], [0, 1000])
    assert set(down.p.tolist()) == {0}
    assert set(up.p.tolist()) == {1}
    # Two thresholds of 0.5 in a change of 1.2, at 5/12 and 10/12 of the time.
    assert sorted(set(down.t_ns.tolist())) == sorted(set(up.t_ns.tolist())) == [417_000, 833_000]


def test_what_remains_below_the_threshold_is_kept_for_later() -> None:
    levels = [np.full(WIDTH, level) for level in (-2.0, -1.6, -1.2, -1.6)]
    got = watch(EXACT, levels, [0, 1000, 2000, 3000])
    assert sorted(set(got.t_ns.tolist())) == [1_250_000]


def test_a_pixel_is_blind_during_its_refractory_period() -> None:
    model = EventModel(threshold=0.5, threshold_sigma=0.0, refractory_us=500)
    got = watch(model, [np.full(WIDTH, -3.0), np.full(WIDTH, -0.9)], [0, 1000])
    # Crossings at 238, 476, 714 and 952 us.
    assert sorted(set(got.t_ns.tolist())) == [238_000, 952_000]


def test_thresholds_spread_from_pixel_to_pixel() -> None:
    model = EventModel(threshold=0.5, threshold_sigma=0.02, refractory_us=0)
    got = watch(model, [np.full(WIDTH, -2.0), np.full(WIDTH, -1.0 - 0.3)], [0, 10_000])
    assert len(got.t_ns) == WIDTH * HEIGHT
    contrast = got.t_ns / 10_000_000 * 0.7
    assert contrast.mean() == pytest.approx(0.5, abs=0.005)
    assert contrast.std() == pytest.approx(0.02, rel=0.2)


def test_the_counting_sort_is_the_stable_order() -> None:
    t_us = np.random.default_rng(3).integers(1000, 1200, 5000)
    assert np.array_equal(_time_order(t_us, 1000, 1199), np.argsort(t_us, kind="stable"))


@pytest.fixture(scope="module")
def texture() -> Texture:
    return make_texture(TextureRecipe(leaves=300))


def test_the_fast_arctangent_is_the_library_s_to_2e_6_rad() -> None:
    angle = np.random.default_rng(1).uniform(-np.pi, np.pi, 2000)
    got = [_atan2(np.float32(np.sin(a)), np.float32(np.cos(a))) for a in angle]
    assert np.abs(np.array(got) - angle).max() < 2e-6


@pytest.mark.parametrize("level", [0, 3])
def test_a_sample_interpolates_between_the_four_texels_around_it(texture: Texture, level: int) -> None:
    size = SIZE >> level
    image = texture.texels[texture.offset[level] : texture.offset[level] + size * size].reshape(size, size)
    rng = np.random.default_rng(level)
    for u, v in rng.uniform(-SIZE, 2 * SIZE, (200, 2)):
        x, y = u / 2**level - 0.5, v / 2**level - 0.5
        i, j = int(np.floor(x)), int(np.floor(y))
        p, q = x - i, y - j
        corner = [[image[(j + b) % size, (i + a) % size] for a in (0, 1)] for b in (0, 1)]
        expected = (1 - q) * ((1 - p) * corner[0][0] + p * corner[0][1]) + q * (
            (1 - p) * corner[1][0] + p * corner[1][1]
        )
        got = sample(
            texture.texels,
            np.uint32(texture.offset[level]),
            np.uint32(size),
            np.float32(0.5**level),
            np.float32(u),
            np.float32(v),
            np.float32(0.0),
        )
        assert got == pytest.approx(expected, abs=2e-3)


def test_each_level_of_the_pyramid_keeps_the_mean(texture: Texture) -> None:
    means = [part.mean() for part in np.split(texture.texels, texture.offset[1:])]
    assert means == pytest.approx([means[0]] * len(means), rel=1e-4)


def looking(yaw: float, pitch: float) -> F64:
    """R_WC of a camera that looks along W's x axis, turned by yaw and then pitch."""
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    (cy, sy), (cp, sp) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch))
    turn = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    tilt = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    return turn @ tilt @ forward


def boxed() -> Scene:
    boxes = np.array([[2.0, 0.5, 1.0, 0.3, 0.4, 1.0, 0.4], [-2.5, -1.0, 1.5, 0.5, 0.3, 0.4, 1.1]])
    return room((9.0, 6.0, 3.5), boxes, seed=2)


@pytest.mark.parametrize("yaw", np.linspace(0.0, 6.0, 7))
def test_a_ray_in_the_room_ends_on_the_first_surface_in_its_way(texture: Texture, yaw: float) -> None:
    camera, scene, p = Camera(80, 60, 60.0, 60.0, 40.0, 30.0), boxed(), np.array([0.1, -0.2, 1.4])
    R_WC = looking(yaw, 0.3)
    renderer = Renderer(scene, texture, camera)
    renderer.render(R_WC, p, np.array([[0, 60, 0, 80]]))
    z = np.arange(0.01, 12.0, 0.01)
    for i, j in np.random.default_rng(1).integers(0, (80, 60), (40, 2)):
        d = R_WC @ np.array([(i - 40.0) / 60.0, (j - 30.0) / 60.0, 1.0])
        points = p + z[:, None] * d
        blocked = (np.abs(points[:, 0]) > 4.5) | (np.abs(points[:, 1]) > 3.0)
        blocked |= (points[:, 2] < 0.0) | (points[:, 2] > 3.5)
        for cx, cy, cz, hx, hy, hz, turn in scene.boxes:
            c, s = np.cos(turn), np.sin(turn)
            x, y = points[:, 0] - cx, points[:, 1] - cy
            blocked |= (np.abs(c * x + s * y) < hx) & (np.abs(c * y - s * x) < hy) & (np.abs(points[:, 2] - cz) < hz)
        # A ray may graze an edge between two of the points tried.
        if abs(renderer.depth[j, i] - z[np.argmax(blocked)]) > 0.011:
            assert renderer.depth[j, i] < z[np.argmax(blocked)]
            assert _on_a_box(scene, p + renderer.depth[j, i] * d)


def _on_a_box(scene: Scene, point: F64) -> bool:
    for cx, cy, cz, hx, hy, hz, turn in scene.boxes:
        c, s = np.cos(turn), np.sin(turn)
        x, y = point[0] - cx, point[1] - cy
        beyond = np.abs([c * x + s * y, c * y - s * x, point[2] - cz]) - (hx, hy, hz)
        if abs(beyond.max()) < 1e-4:
            return True
    return False


@pytest.mark.parametrize("yaw", np.linspace(0.0, 6.0, 7))
def test_a_ray_in_the_corridor_ends_on_a_wall_the_floor_or_the_ceiling(texture: Texture, yaw: float) -> None:
    camera, p = Camera(80, 60, 60.0, 60.0, 40.0, 30.0), np.array([8.2, 0.3, 1.2])
    R_WC = looking(yaw, -0.2)
    renderer = Renderer(corridor(7.0, 10.0, 3.0, 1), texture, camera)
    renderer.render(R_WC, p, np.array([[0, 60, 0, 80]]))
    i, j = np.meshgrid(np.arange(80), np.arange(60))
    d = np.stack([(i - 40.0) / 60.0, (j - 30.0) / 60.0, np.ones(i.shape)], axis=-1) @ R_WC.T
    points = p + renderer.depth[..., None].astype(np.float64) * d
    r = np.hypot(points[..., 0], points[..., 1])
    off = np.min(np.abs([r - 7.0, r - 10.0, points[..., 2], points[..., 2] - 3.0]), axis=0)
    assert off.max() < 1e-5
    # Nothing is in the way: halfway every ray is still inside.
    halfway = p + 0.5 * renderer.depth[..., None] * d
    r = np.hypot(halfway[..., 0], halfway[..., 1])
    assert r.min() > 7.0
    assert r.max() < 10.0


def test_the_texture_has_contrast_for_several_thresholds_and_no_large_empty_place() -> None:
    image = np.log(make_texture(TextureRecipe()).texels[: SIZE * SIZE].reshape(SIZE, SIZE))
    assert image.max() - image.min() > 4 * 0.5
    # Squares of 2 m.
    side = round(2.0 / TEXEL_M)
    squares = image[: 4 * side, : 4 * side].reshape(4, side, 4, side)
    assert squares.std(axis=(1, 3)).min() > 0.4
