"""Trajectories, IMU and whole sequences: derivatives, geometry and statistics that a wrong simulator would fail."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from velod.geometry.camera import A_v, B_w
from velod.geometry.so3 import exp, log
from velod.io import open_recording, read_depth
from velod.sim import HELD_OUT, TABLE_I, SequenceError, sequence, simulate, simulated_recording
from velod.sim.imu import GRAVITY_W, ImuModel, sample_imu
from velod.sim.recipe import BASELINE_M
from velod.sim.render import Renderer
from velod.sim.sequences import mean_motion
from velod.sim.texture import Texture, TextureRecipe, make_texture
from velod.sim.trajectory import shaken
from velod.sim.waves import Waves, integral, power, product

NAMES = sorted(TABLE_I)
OTHERS = sorted(HELD_OUT)
MOMENTS = np.linspace(0.0, 20.0, 11)


@pytest.fixture(scope="module")
def texture() -> Texture:
    return make_texture(TextureRecipe(leaves=300))


@pytest.mark.parametrize("name", NAMES)
def test_mean_speeds_are_those_of_table_1_within_2_percent(name: str) -> None:
    assert mean_motion(sequence(name).trajectory) == pytest.approx(TABLE_I[name], rel=0.02)


@pytest.mark.parametrize("name", [*NAMES, *OTHERS])
def test_velocities_and_accelerations_are_the_derivatives_of_the_poses(name: str) -> None:
    trajectory, h = sequence(name).trajectory, 1e-5
    before, now, after = (trajectory.at(MOMENTS + k * h) for k in (-1, 0, 1))
    scale = 1.0 + np.abs(now.a_W).max()
    assert np.allclose((after.p_WB - before.p_WB) / (2 * h), now.v_W, atol=1e-6 * scale)
    assert np.allclose((after.v_W - before.v_W) / (2 * h), now.a_W, atol=1e-5 * scale)
    turned = log(before.R_WB.transpose(0, 2, 1) @ after.R_WB) / (2 * h)
    assert np.allclose(turned, now.omega_B, atol=1e-5)
    assert np.allclose(now.R_WB @ now.R_WB.transpose(0, 2, 1), np.eye(3), atol=1e-12)


@pytest.mark.parametrize("name", ["corridor-1", "boxes-4", "spin-2"])
def test_eq_1_is_the_motion_of_what_the_renderer_shows(name: str, texture: Texture) -> None:
    recipe, h = sequence(name), 1e-5
    camera = recipe.calibration.left
    renderer = Renderer(recipe.scene, texture, camera)
    before, now, after = (recipe.trajectory.at(np.array([1.3 + k * h])) for k in (-1, 0, 1))
    renderer.render(now.R_WB[0], now.p_WB[0], np.array([[0, camera.height, 0, camera.width]]))
    i, j = (a.ravel() for a in np.meshgrid(np.arange(5, 346, 20), np.arange(5, 260, 20)))
    x, y, z = i - camera.cx, j - camera.cy, renderer.depth[j, i].astype(np.float64)
    point_W = now.p_WB[0] + (np.stack([x * z / camera.fx, y * z / camera.fy, z], axis=1)) @ now.R_WB[0].T
    seen = []
    for pose in (before, after):
        q = (point_W - pose.p_WB[0]) @ pose.R_WB[0]
        seen.append(camera.fx * q[:, :2] / q[:, 2:])
    flow = (A_v(x, y, camera.fx) @ now.v_B[0]) / z[:, None] + B_w(x, y, camera.fx) @ now.omega_B[0]
    assert np.allclose((seen[1] - seen[0]) / (2 * h), flow, atol=1e-3 * (1 + np.abs(flow).max()))


@pytest.mark.parametrize("name", ["corridor-1", "boxes-4"])
def test_a_point_appears_f_b_over_z_further_left_in_the_right_camera(name: str, texture: Texture) -> None:
    recipe = sequence(name)
    camera, pose = recipe.calibration.left, recipe.trajectory.at(np.array([0.7]))
    whole, R_WB, p_WB = np.array([[0, camera.height, 0, camera.width]]), pose.R_WB[0], pose.p_WB[0]
    left, right = (Renderer(recipe.scene, texture, camera) for _ in range(2))
    left.render(R_WB, p_WB, whole)
    right.render(R_WB, p_WB + R_WB @ np.array([BASELINE_M, 0.0, 0.0]), whole)
    disparity = camera.fx * BASELINE_M / left.depth
    j, i = np.mgrid[20:240:3, 60:340:3]
    at = i - disparity[j, i]
    low = np.floor(at).astype(int)
    share = at - low
    depth = (1 - share) * right.depth[j, low] + share * right.depth[j, low + 1]
    same = np.abs(depth - left.depth[j, i]) < 0.01
    assert same.mean() > 0.85  # the rest is hidden from one of the cameras
    seen = (1 - share) * right.intensity[j, low] + share * right.intensity[j, low + 1]
    assert np.corrcoef(seen[same], left.intensity[j, i][same])[0, 1] > 0.98
    # How far the two still are apart along the row, by least squares: not at all.
    slope = np.gradient(left.intensity, axis=1)[j, i][same]
    apart_px = np.sum(slope * (seen[same] - left.intensity[j, i][same])) / np.sum(slope**2)
    assert abs(apart_px) < 0.02


@pytest.mark.parametrize("name", ["corridor-3", "boxes-5"])
def test_a_clean_imu_integrates_back_to_the_truth(name: str) -> None:
    recipe = sequence(name)
    imu = sample_imu(recipe.trajectory, ImuModel().noiseless(), 2.0, np.random.default_rng(0))
    truth = recipe.trajectory.at(imu.t_ns / 1e9)
    R, v = truth.R_WB[0], truth.v_W[0]
    for k, dt in enumerate(np.diff(imu.t_ns) / 1e9):
        half = exp(0.25 * dt * (imu.gyro[k] + imu.gyro[k + 1]))
        v = v + dt * (R @ half @ (0.5 * (imu.accel[k] + imu.accel[k + 1])) - GRAVITY_W)
        R = R @ half @ half
    assert np.linalg.norm(R.T @ v - truth.v_B[-1]) < 1e-3 * max(1.0, np.linalg.norm(v) / 2)


def test_noise_is_a_density_times_the_root_of_the_rate_and_biases_wander() -> None:
    recipe = sequence("corridor-1")
    clean = sample_imu(recipe.trajectory, ImuModel().noiseless(), 100.0, np.random.default_rng(0))
    noisy = sample_imu(recipe.trajectory, ImuModel(), 100.0, np.random.default_rng(0))
    error = noisy.accel - clean.accel
    assert np.diff(error, axis=0).std() == pytest.approx(np.sqrt(2.0) * 1.86e-2 * np.sqrt(200.0), rel=0.02)
    assert np.diff(noisy.gyro - clean.gyro, axis=0).std() == pytest.approx(
        np.sqrt(2.0) * 1.86e-3 * np.sqrt(200.0), rel=0.02
    )
    # 4.33e-3 * sqrt(100 s) = 0.043 at the end; the mean of the last second has white noise 0.019.
    assert 0.01 < np.abs(error[-200:].mean(axis=0)).max() < 0.2


def test_an_imu_at_rest_would_show_gravity_upwards() -> None:
    recipe = sequence("corridor-1")
    clean = sample_imu(recipe.trajectory, ImuModel().noiseless(), 60.0, np.random.default_rng(0))
    # B's y points down: the mean specific force along it is -9.81.
    assert clean.accel[:, 1].mean() == pytest.approx(-9.81, abs=0.1)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sim") / "corridor.h5"
    simulate(sequence("corridor-1"), 0.12, 7, path)
    return path


def test_a_recording_has_events_of_both_polarities_at_a_sensible_rate(recorded: Path) -> None:
    recording = open_recording(recorded)
    with h5py.File(recorded) as file:
        for side in ("left", "right"):
            p = file[f"events/{side}/p"][:]
            assert 0.45 < p.mean() < 0.55
            assert 1e6 < len(p) / 0.12 < 5e6
    assert recording.truth is not None
    assert recording.truth.t_ns[-1] == 120_000_000
    assert len(recording.imu.t_ns) == 25
    depth = read_depth(recorded)
    assert depth is not None
    assert depth.t_ns.tolist() == [0, 100_000_000]
    # Nearer than f b / 48 nothing could be matched.
    assert depth.left.min() > 231.5 * BASELINE_M / 48


def test_the_same_seed_gives_the_same_bytes_and_another_one_does_not(recorded: Path, tmp_path: Path) -> None:
    shares: list[float] = []
    simulate(sequence("corridor-1"), 0.12, 7, tmp_path / "same.h5", shares.append)
    simulate(sequence("corridor-1"), 0.12, 8, tmp_path / "other.h5")
    assert (tmp_path / "same.h5").read_bytes() == recorded.read_bytes()
    assert (tmp_path / "other.h5").read_bytes() != recorded.read_bytes()
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_a_simulated_recording_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VELOD_CACHE_DIR", str(tmp_path))
    path = simulated_recording("corridor-1", 0.01, 1)
    made_ns = path.stat().st_mtime_ns
    assert simulated_recording("corridor-1", 0.01, 1) == path
    assert path.stat().st_mtime_ns == made_ns
    assert simulated_recording("corridor-1", 0.01, 2) != path


def test_a_damaged_recording_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VELOD_CACHE_DIR", str(tmp_path))
    path = simulated_recording("corridor-1", 0.01, 1)
    whole = path.read_bytes()
    path.write_bytes(whole[:1000])
    assert simulated_recording("corridor-1", 0.01, 1).read_bytes() == whole


def test_an_unknown_sequence_lists_the_known_ones() -> None:
    with pytest.raises(SequenceError, match=r"unknown sequence 'corridor'; known: corridor-1, .*spin-3"):
        sequence("corridor")


# --- motions of other kinds ---


@pytest.mark.parametrize("name", OTHERS)
def test_no_other_motion_comes_close_to_a_wall_or_a_box(name: str) -> None:
    recipe = sequence(name)
    p_WB = recipe.trajectory.at(np.linspace(0.0, 60.0, 6000)).p_WB
    low, high = recipe.scene.shell[:3], recipe.scene.shell[3:]
    assert (p_WB > low + 1.0).all() and (p_WB < high - 1.0).all()
    reach = np.linalg.norm(recipe.scene.boxes[:, 3:6], axis=1)
    assert (np.linalg.norm(p_WB[:, None] - recipe.scene.boxes[:, :3], axis=2) > reach + 0.7).all()


def test_the_walk_stops_and_goes_on() -> None:
    motion = sequence("walk-1").trajectory.at(np.arange(0.0, 40.0, 0.01))
    speed = np.linalg.norm(motion.v_W, axis=1)
    assert 0.3 < np.mean(speed < 0.05) < 0.5
    assert speed.max() == pytest.approx(1.9, abs=0.1)


def test_the_flip_starts_upside_down_and_comes_to_stand_upright() -> None:
    down_W = sequence("flip-1").trajectory.at(np.arange(0.0, 20.0, 0.01)).R_WB[:, :, 1]
    assert down_W[0, 2] > 0.9
    assert down_W[:, 2].min() < -0.2


def test_the_hover_turns_on_the_spot() -> None:
    motion = sequence("hover-1").trajectory.at(np.arange(0.0, 40.0, 0.01))
    speed, rate = np.linalg.norm(motion.v_W, axis=1), np.linalg.norm(motion.omega_B, axis=1)
    assert speed.max() > 4.0
    assert np.mean((speed < 0.3) & (rate > 1.0)) > 0.05


def test_another_texture_changes_what_is_seen_and_not_the_motion() -> None:
    plain, other = sequence("boxes-4"), sequence("boxes-4", texture_seed=9)
    assert plain.trajectory == other.trajectory
    assert (plain.texture.seed, other.texture.seed) == (1, 9)


# --- sums of sines ---

SOME = ((0.3, 1.7, 0.2), (-1.1, 0.4, 2.0), (0.7, 0.0, 0.5 * np.pi))
MORE = ((0.9, 1.7, -0.4), (0.2, 5.0, 1.0))


def value(waves: Waves, t: np.ndarray) -> np.ndarray:
    return sum((a * np.sin(w * t + phase) for a, w, phase in waves), np.zeros_like(t))


def test_products_and_powers_of_sums_of_sines_are_sums_of_sines() -> None:
    t = np.linspace(-3.0, 9.0, 200)
    assert np.allclose(value(product(SOME, MORE), t), value(SOME, t) * value(MORE, t), atol=1e-12)
    assert np.allclose(value(power((1.3, 0.8, 0.3), 5), t), (1.3 * np.sin(0.8 * t + 0.3)) ** 5, atol=1e-12)
    assert len(power((1.0, 0.8, 0.0), 6)) <= 5  # equal frequencies are one wave


def test_the_integral_starts_where_it_is_told_and_has_its_sum_as_derivative() -> None:
    t = np.linspace(0.0, 9.0, 200)
    x, dx, _ = integral(SOME, start=2.5).at(t)
    assert x[0] == pytest.approx(2.5)
    assert np.allclose(dx, value(SOME, t), atol=1e-12)


def test_a_vibration_adds_a_sine_to_the_velocity_and_its_derivatives_fit() -> None:
    calm = sequence("spin-2").trajectory
    shaking = shaken(calm, 1.0, 8.0)
    t_s, h = np.linspace(0.0, 0.5, 2001), 1e-6
    added = shaking.at(t_s).v_W - calm.at(t_s).v_W
    assert np.isclose(np.linalg.norm(added, axis=1).max(), 1.0, atol=1e-4)
    assert np.allclose(added, np.sin(16.0 * np.pi * t_s)[:, None] / np.sqrt(3.0), atol=1e-9)
    before, now, after = (shaking.at(t_s + dt) for dt in (-h, 0.0, h))
    assert np.allclose((after.p_WB - before.p_WB) / (2 * h), now.v_W, atol=1e-6)
    assert np.allclose((after.v_W - before.v_W) / (2 * h), now.a_W, atol=1e-5)
    assert np.array_equal(now.R_WB, calm.at(t_s).R_WB)
