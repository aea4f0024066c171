"""Rectification: the same point lies in the same row of both images, and the tables agree with each other."""

from dataclasses import fields

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from velod.geometry import so3
from velod.geometry.calibration import Calibration, Camera
from velod.geometry.camera import distort, pixels
from velod.geometry.rectify import Rectification, rectified_pair, rectify

PLAIN = Camera(346, 260, 231.5, 231.5, 172.3, 130.8)
RADTAN = Camera(346, 260, 249.7, 248.4, 176.7, 129.5, "radtan", (-0.379, 0.154, 0.00114, -0.0019))
EQUI = Camera(346, 260, 226.4, 226.2, 173.6, 133.7, "equi", (-0.048, 0.0113, -0.0554, 0.0215))
R_RL = so3.exp([0.02, -0.03, 0.01])
T_CAM_IMU = np.block(
    [[so3.exp([0.1, 0.2, -0.3]), np.array([[0.01], [0.02], [-0.06]])], [np.zeros((1, 3)), np.eye(1)]]
)
TILTED = [
    Calibration(RADTAN, EQUI, R_RL, np.array([-0.1, 0.003, -0.002]), T_CAM_IMU),
    Calibration(EQUI, RADTAN, R_RL.T, np.array([-0.06, -0.001, 0.001]), T_CAM_IMU),
]
PAIRS = pytest.mark.parametrize("calib", TILTED, ids=["radtan-equi", "equi-radtan"])


def see(camera: Camera, P: np.ndarray) -> np.ndarray:
    """Sensor px of points (m, 3) in the camera's frame."""
    return pixels(distort(P[:, :2] / P[:, 2:], camera)[0], camera)


def look_up(table: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Bilinear; cv2.remap would round positions to 1/32 px."""
    columns = table.reshape(*table.shape[:2], -1).astype(np.float64)
    return np.stack([map_coordinates(c, px.T[::-1], order=1) for c in np.moveaxis(columns, -1, 0)], axis=-1).squeeze()


def points(rect: Rectification) -> np.ndarray:
    """Points in frame C, in view of both cameras."""
    rng = np.random.default_rng(3)
    P = rng.uniform([-0.35, -0.3, 1.0], [0.35, 0.3, 1.0], (200, 3))
    return P * rng.uniform(1.0, 5.0, (200, 1)) + np.array([rect.baseline_m / 2, 0, 0])


@PAIRS
def test_a_point_lies_in_one_row_and_its_disparity_is_f_b_over_z(calib: Calibration) -> None:
    rect = rectify(calib)
    P_C = points(rect)
    P_left = P_C @ rect.R_rect_left
    left = look_up(rect.left_xy, see(calib.left, P_left))
    right = look_up(rect.right_xy, see(calib.right, P_left @ calib.R_RL.T + calib.t_RL))
    expected = rect.f * P_C[:, :2] / P_C[:, 2:] + [rect.cx, rect.cy]
    np.testing.assert_allclose(left, expected, atol=0.01)
    np.testing.assert_allclose(right[:, 1], left[:, 1], atol=0.01)
    np.testing.assert_allclose(left[:, 0] - right[:, 0], rect.f * rect.baseline_m / P_C[:, 2], atol=0.01)


@PAIRS
def test_the_backward_tables_undo_the_forward_ones(calib: Calibration) -> None:
    rect = rectify(calib)
    for forward, (map_x, map_y) in ((rect.left_xy, rect.remap_left), (rect.right_xy, rect.remap_right)):
        x, y = forward[..., 0], forward[..., 1]
        inside = (x > 1) & (x < rect.width - 2) & (y > 1) & (y < rect.height - 2)
        rows, columns = np.nonzero(inside)
        assert len(rows) > 0.8 * inside.size, "most of the sensor must be on the rectified grid"
        np.testing.assert_allclose(look_up(map_x, forward[rows, columns]), columns, atol=0.01)
        np.testing.assert_allclose(look_up(map_y, forward[rows, columns]), rows, atol=0.01)


@PAIRS
def test_the_covector_map_is_the_transposed_inverse_of_the_position_maps_jacobian(calib: Calibration) -> None:
    rect = rectify(calib)
    for xy, M in ((rect.left_xy, rect.left_covector), (rect.right_xy, rect.right_covector)):
        xy64 = xy.astype(np.float64)
        # Central differences over 8 px: float32 positions are good to 3e-5 px.
        J = np.stack([xy64[4:-4, 8:] - xy64[4:-4, :-8], xy64[8:, 4:-4] - xy64[:-8, 4:-4]], axis=-1) / 8.0
        product = np.swapaxes(J, -1, -2) @ M[4:-4, 4:-4]
        np.testing.assert_allclose(product[60:-60, 60:-60], np.broadcast_to(np.eye(2), (132, 218, 2, 2)), atol=0.01)


def test_a_gradient_of_time_is_the_same_slope_on_both_grids() -> None:
    """The covector of t = a x_rect + b y_rect, read off the sensor grid, is (a, b) again."""
    rect = rectify(TILTED[0])
    a, b = 0.003, -0.002
    t = (rect.left_xy.astype(np.float64) * [a, b]).sum(axis=-1)
    y, x = 100, 220
    grad_sensor = [(t[y, x + 2] - t[y, x - 2]) / 4, (t[y + 2, x] - t[y - 2, x]) / 4]
    np.testing.assert_allclose(rect.left_covector[y, x] @ grad_sensor, [a, b], rtol=2e-3)


def test_a_rectified_pair_keeps_its_camera_matrix_exactly() -> None:
    rect = rectify(Calibration(PLAIN, PLAIN, np.eye(3), np.array([-0.12, 0.0, 0.0])))
    assert rect.identity
    assert (rect.width, rect.height, rect.f, rect.cx, rect.cy) == (346, 260, 231.5, 172.3, 130.8)
    assert rect.baseline_m == pytest.approx(0.12, abs=1e-15)
    np.testing.assert_allclose(rect.left_xy[17, 33], [33, 17], atol=1e-4)
    np.testing.assert_allclose(rect.left_covector[17, 33], np.eye(2), atol=1e-6)
    np.testing.assert_array_equal(rect.R_CB, np.eye(3))


@pytest.mark.parametrize(
    ("left", "right", "t_RL"),
    [
        (RADTAN, RADTAN, (-0.1, 0.0, 0.0)),
        (PLAIN, Camera(346, 260, 231.5, 231.5, 170.0, 130.8), (-0.1, 0.0, 0.0)),
        (PLAIN, PLAIN, (-0.1, 0.001, 0.0)),
    ],
    ids=["distorted", "other principal point", "oblique baseline"],
)
def test_a_pair_that_is_not_rectified_is_not_taken_for_one(
    left: Camera, right: Camera, t_RL: tuple[float, float, float]
) -> None:
    assert not rectify(Calibration(left, right, np.eye(3), np.array(t_RL))).identity


@PAIRS
def test_the_pose_of_the_body_closes(calib: Calibration) -> None:
    """p_C by way of T_cam_imu and by way of R_CB, p_BC_B."""
    rect = rectify(calib)
    p_B = np.array([0.3, -0.2, 2.0])
    p_left = calib.T_cam_imu[:3, :3] @ p_B + calib.T_cam_imu[:3, 3]
    np.testing.assert_allclose(rect.R_CB @ (p_B - rect.p_BC_B), rect.R_rect_left @ p_left, atol=1e-12)


def test_sensor_pixels_beyond_the_lens_model_are_nan_in_every_table() -> None:
    barrel = Camera(300, 300, 100.0, 100.0, 149.5, 149.5, "radtan", (-0.3, 0.0, 0.0, 0.0))
    rect = rectify(Calibration(barrel, barrel, np.eye(3), np.array([-0.1, 0.0, 0.0])))
    assert np.isnan(rect.left_xy[0, 0]).all()
    assert np.isnan(rect.left_covector[0, 0]).all()
    assert np.isfinite(rect.left_xy[150, 150]).all()
    assert np.isnan(rect.left_xy[..., 0]).mean() < 0.9


def test_tables_are_made_once_for_one_calibration_and_anew_for_another() -> None:
    first, again, wider = (
        rectify(Calibration(RADTAN, RADTAN, np.eye(3), np.array([-baseline_m, 0.0, 0.0])))
        for baseline_m in (0.1, 0.1, 0.2)
    )
    assert again is first
    assert wider.baseline_m == pytest.approx(2.0 * first.baseline_m)


@PAIRS
def test_the_pair_is_the_same_with_tables_and_without(calib: Calibration) -> None:
    pair, rect = rectified_pair(calib), rectify(calib)
    for f in fields(pair):
        np.testing.assert_array_equal(getattr(pair, f.name), getattr(rect, f.name))
