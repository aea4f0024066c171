"""A pixel's light is the mean over rays that are spread evenly over its area."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from velod.cli import main
from velod.geometry.calibration import Camera
from velod.sim import sequence, simulate, simulated_recording
from velod.sim.area import AreaRenderer, finer, mean_of_squares, renderer_of
from velod.sim.cast import rays_of
from velod.sim.effects import SensorError
from velod.sim.render import Renderer
from velod.sim.scene import Scene, room
from velod.sim.texture import COARSEST, SIZE, Texture
from velod.types import F32, F64

CAMERA = Camera(40, 24, 30.0, 30.0, 19.5, 11.5)
WHOLE = np.array([[0, 24, 0, 40]])
ALONG_X = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""R_WC of a camera that looks along W's x axis."""


@pytest.mark.parametrize("side", [1, 2, 3, 4])
def test_a_pixel_is_the_mean_of_its_square_of_rays(side: int) -> None:
    fine: F32 = np.random.default_rng(side).random((6 * side, 9 * side), np.float32)
    out: F32 = np.full((6, 9), -1.0, np.float32)
    mean_of_squares(fine, side, np.array([[0, 2, 1, 9], [3, 6, 0, 4]]), out)
    expected = fine.reshape(6, side, 9, side).mean(axis=(1, 3))
    wanted = np.zeros((6, 9), bool)
    wanted[0:2, 1:9] = wanted[3:6, 0:4] = True
    assert np.allclose(out[wanted], expected[wanted], atol=1e-6)
    assert (out[~wanted] == -1.0).all()


@pytest.mark.parametrize("side", [2, 3, 4])
def test_the_rays_of_a_pixel_lie_evenly_about_its_centre(side: int) -> None:
    fine = rays_of(finer(CAMERA, side)).reshape(2, 24, side, 40, side)
    assert np.allclose(fine.mean(axis=(2, 4)), rays_of(CAMERA), atol=1e-6)
    # From the first ray of a pixel to that of the next one it is one pixel, in even steps.
    along = fine[0, 0, 0].ravel()
    assert np.allclose(np.diff(along), 1.0 / (CAMERA.fx * side), atol=1e-6)


def black_and_white() -> Texture:
    """Texels of 0.1 up to u = 4.096 m, of 0.9 from there on."""
    levels = [np.where(np.arange(SIZE >> k) < SIZE >> k + 1, 0.1, 0.9) for k in range(COARSEST + 1)]
    texels = np.concatenate([np.tile(row, len(row)) for row in levels]).astype(np.float32)
    offset = np.cumsum([0] + [len(row) ** 2 for row in levels[:-1]], dtype=np.int64)
    return Texture(texels, np.full_like(texels, -1.0), offset)


def white_box_before_black_walls() -> Scene:
    """One box 3 m ahead, its left outline between the centres of two pixels; every surface is of one tone."""
    box = np.array([[3.0, 0.02 - 0.4, 1.5, 0.1, 0.4, 5.0, 0.0]])
    scene = room((12.0, 3.0, 12.0), box, seed=1)
    surfaces = scene.surfaces.copy()
    surfaces[:6, 9], surfaces[6:, 9] = 2.0, 6.1
    surfaces[:, 3:9] *= 0.01  # no surface reaches from one tone to the other
    return Scene(scene.shell, scene.boxes, surfaces)


def seen(side: int) -> F32:
    """(24, 40), of a camera that is rolled by 0.2 rad, so that the outlines cross pixels everywhere."""
    c, s = np.cos(0.2), np.sin(0.2)
    rolled: F64 = ALONG_X @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    view = renderer_of(white_box_before_black_walls(), black_and_white(), CAMERA, side)
    view.render(rolled, np.array([0.0, 0.0, 1.5]), WHOLE)
    return view.intensity


def test_an_outline_crosses_a_pixel_gradually_only_where_it_has_an_area() -> None:
    one, many = seen(1), seen(4)
    dark, bright = pytest.approx(0.1, abs=1e-3), pytest.approx(0.9, abs=1e-3)
    assert all(value in (dark, bright) for value in np.unique(one))
    # Sixteenths of the step, and the share of pixels between is that which two outlines, 24 rows high, cross.
    sixteenths = (many - 0.1) / 0.8 * 16.0
    assert np.allclose(sixteenths, np.rint(sixteenths), atol=0.02)
    between = (many > 0.15) & (many < 0.85)
    assert 2 * 24 * 0.9 < between.sum() < 2 * 24 * 1.5
    # Away from the outlines both see the same.
    assert np.allclose(one[~between], many[~between], atol=0.06)


def test_the_depth_stays_that_of_the_centre() -> None:
    scene, texture = white_box_before_black_walls(), black_and_white()
    one, many = Renderer(scene, texture, CAMERA), AreaRenderer(scene, texture, CAMERA, 3)
    for view in (one, many):
        view.render(ALONG_X, np.array([0.0, 0.0, 1.5]), WHOLE)
    assert np.array_equal(one.depth, many.depth)
    assert len(np.unique(np.rint(one.depth))) > 1


def test_a_recording_of_other_rays_is_kept_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VELOD_CACHE_DIR", str(tmp_path))
    one = sequence("corridor-1")
    paths = []
    for recipe in (one, replace(one, rays_per_side=2)):
        monkeypatch.setattr("velod.sim.driver.sequence", lambda *_, recipe=recipe: recipe)
        paths.append(simulated_recording("corridor-1", 0.01, 1))
    assert paths[0] != paths[1]
    assert paths[0].read_bytes() != paths[1].read_bytes()


def test_the_command_line_asks_for_the_rays_of_the_recipe(tmp_path: Path) -> None:
    typed, called = tmp_path / "typed.h5", tmp_path / "called.h5"
    assert main(["sim", "corridor-1", "-o", str(typed), "--seconds", "0.01", "--rays", "2"]) == 0
    simulate(replace(sequence("corridor-1"), rays_per_side=2), 0.01, 1, called)
    assert typed.read_bytes() == called.read_bytes()


@pytest.mark.parametrize(
    ("rays", "width", "text"),
    [(0, 346, "must be 1 to 4, got 0"), (5, 346, "must be 1 to 4, got 5"), (4, 640, r"640 pixels times 4 = 2560")],
)
def test_rays_that_cannot_be_cast_are_refused(rays: int, width: int, text: str) -> None:
    with pytest.raises(SensorError, match=text):
        replace(sequence("boxes-4"), rays_per_side=rays, sensor=(width, 480))
