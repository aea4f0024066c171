"""Lens models against OpenCV; Eq. 1 against a moving point; every Jacobian against central differences."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from velod.geometry import so3
from velod.geometry.calibration import Camera
from velod.geometry.camera import (
    A_v,
    B_w,
    distort,
    model_radius,
    motion_field_rows,
    normalised,
    pixels,
    undistort,
)

RADTAN = Camera(346, 260, 249.7, 248.4, 176.7, 129.5, "radtan", (-0.379, 0.154, 0.00114, -0.0019, 0.01))
EQUI = Camera(346, 260, 226.4, 226.2, 173.6, 133.7, "equi", (-0.048, 0.0113, -0.0554, 0.0215))
CAMERAS = pytest.mark.parametrize("camera", [RADTAN, EQUI], ids=["radtan", "equi"])


def K(camera: Camera) -> np.ndarray:
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def sensor_points(camera: Camera) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 13), np.linspace(0, camera.height - 1, 11))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def test_radtan_distorts_as_opencv() -> None:
    p = undistort(normalised(sensor_points(RADTAN), RADTAN), RADTAN)
    rays = np.column_stack([p, np.ones(len(p))])
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K(RADTAN), np.array(RADTAN.dist))
    np.testing.assert_allclose(pixels(distort(p, RADTAN)[0], RADTAN), expected[:, 0], atol=1e-9)


def test_equi_distorts_as_opencv() -> None:
    p = undistort(normalised(sensor_points(EQUI), EQUI), EQUI)
    expected = cv2.fisheye.distortPoints(p[:, None], K(EQUI), np.array(EQUI.dist))
    np.testing.assert_allclose(pixels(distort(p, EQUI)[0], EQUI), expected[:, 0], atol=1e-9)


@CAMERAS
def test_undistort_undoes_distort_over_the_whole_sensor(camera: Camera) -> None:
    px = sensor_points(camera)
    p = undistort(normalised(px, camera), camera)
    np.testing.assert_allclose(pixels(distort(p, camera)[0], camera), px, atol=1e-6)


def test_undistort_agrees_with_opencv_near_the_centre() -> None:
    # OpenCV stops after five rounds of a fixed point: exact near the centre only.
    px = sensor_points(RADTAN) * 0.25 + np.array([RADTAN.cx, RADTAN.cy]) * 0.75
    expected = cv2.undistortPoints(px[:, None], K(RADTAN), np.array(RADTAN.dist))
    np.testing.assert_allclose(undistort(normalised(px, RADTAN), RADTAN), expected.reshape(-1, 2), atol=1e-8)


@CAMERAS
def test_the_distortion_jacobian_equals_central_differences(camera: Camera) -> None:
    p = np.vstack([undistort(normalised(sensor_points(camera), camera), camera), [[0.0, 0.0]]])
    J, h = distort(p, camera)[1], 1e-6
    for i in range(2):
        step = h * np.eye(2)[i]
        numeric = (distort(p + step, camera)[0] - distort(p - step, camera)[0]) / (2 * h)
        np.testing.assert_allclose(J[:, :, i], numeric, atol=1e-8)


def test_a_position_beyond_the_fold_of_the_lens_model_is_nan() -> None:
    barrel = Camera(200, 200, 100.0, 100.0, 99.5, 99.5, "radtan", (-0.3, 0.0, 0.0, 0.0))
    # r (1 - 0.3 r^2) grows up to r = 1.05, to 0.70: no ray lands further out.
    inside, outside = undistort(np.array([[0.6, 0.0], [0.8, 0.0]]), barrel)
    assert inside[0] == pytest.approx(0.6 / (1 - 0.3 * inside[0] ** 2), abs=1e-9)
    assert np.isnan(outside).all()
    assert 0.9 < model_radius(barrel) < 1.06


def test_motion_field_is_the_derivative_of_the_projection() -> None:
    """Eq. 1: a static point seen by a camera that moves with v, w."""
    rng = np.random.default_rng(1)
    f, h = 231.5, 1e-6
    for _ in range(20):
        P = rng.uniform([-1, -1, 1.5], [1, 1, 6])
        v, w = rng.normal(size=3), rng.normal(size=3)

        def project(dt: float, P: np.ndarray = P, v: np.ndarray = v, w: np.ndarray = w) -> np.ndarray:
            Q = so3.exp(w * dt).T @ (P - v * dt)
            return f * Q[:2] / Q[2]

        x, y = project(0.0)
        flow = A_v(x, y, f) @ v / P[2] + B_w(x, y, f) @ w
        np.testing.assert_allclose(flow, (project(h) - project(-h)) / (2 * h), rtol=1e-6, atol=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_motion_field_rows_are_n_times_A_and_B(seed: int) -> None:
    """Eq. 4; the numpy twin of the kernel."""
    rng = np.random.default_rng(seed)
    x, y, angle = rng.uniform(0, 346, 7), rng.uniform(0, 260, 7), rng.uniform(0, 2 * np.pi, 7)
    n = np.column_stack([np.cos(angle), np.sin(angle)])
    f, cx, cy = 231.5, 172.3, 130.8
    nA, nB = motion_field_rows(x, y, f, cx, cy, n)
    np.testing.assert_allclose(nA, np.einsum("mi,mij->mj", n, A_v(x - cx, y - cy, f)), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(nB, np.einsum("mi,mij->mj", n, B_w(x - cx, y - cy, f)), rtol=1e-12, atol=1e-9)
