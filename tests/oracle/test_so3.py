"""Rotations against scipy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from velod.geometry import so3

vectors = arrays(np.float64, 3, elements=st.floats(-1.8, 1.8))
# Both sides of the switch between series and closed form, and zero.
LENGTHS = [0.0, 1e-12, 1e-6, 0.0099, 0.0101, 0.5, 3.0]


def of_length(length: float) -> np.ndarray:
    return length * np.array([2.0, -3.0, 6.0]) / 7.0


@pytest.mark.parametrize("length", [*LENGTHS, np.pi])
def test_exp_and_the_kernel_equal_scipy_at_any_angle(length: float) -> None:
    w = of_length(length)
    expected = Rotation.from_rotvec(w).as_matrix()
    out = np.empty((3, 3))
    so3.exp_so3(w, out)
    np.testing.assert_allclose(so3.exp(w), expected, atol=1e-13)
    np.testing.assert_allclose(out, expected, atol=1e-13)


@given(vectors)
def test_log_undoes_exp_below_half_a_turn(w: np.ndarray) -> None:
    w = w if np.linalg.norm(w) < 3.1 else w / 2.0
    np.testing.assert_allclose(so3.log(so3.exp(w)), w, atol=1e-10)
    out = np.empty(3)
    so3.log_so3(so3.exp(w), out)
    np.testing.assert_allclose(out, w, atol=1e-8)


@given(vectors)
def test_quaternions_are_xyzw_as_scipys(w: np.ndarray) -> None:
    R = Rotation.from_rotvec(w)
    q = so3.quaternion_from_matrix(R.as_matrix())
    np.testing.assert_allclose(q, R.as_quat(canonical=True), atol=1e-12)
    np.testing.assert_allclose(so3.matrix_from_quaternion(3.0 * q), R.as_matrix(), atol=1e-12)
    out = np.empty(4)
    so3.quaternion_so3(R.as_matrix(), out)
    np.testing.assert_allclose(out, q, atol=1e-14)


def test_a_half_turn_about_each_axis_has_a_quaternion() -> None:
    for R in (np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])):
        np.testing.assert_allclose(so3.matrix_from_quaternion(so3.quaternion_from_matrix(R)), R, atol=1e-15)
        out = np.empty(4)
        so3.quaternion_so3(R, out)
        np.testing.assert_allclose(so3.matrix_from_quaternion(out), R, atol=1e-15)


@pytest.mark.parametrize("length", LENGTHS)
def test_right_jacobian_equals_central_differences(length: float) -> None:
    w, h = of_length(length), 1e-6
    for i in range(3):
        dw = h * np.eye(3)[i]
        # exp(w)^T exp(w +- dw) = exp(+- J_r dw)
        plus, minus = (so3.log(so3.exp(w).T @ so3.exp(w + s * dw)) for s in (1.0, -1.0))
        np.testing.assert_allclose(so3.right_jacobian(w)[:, i], (plus - minus) / (2 * h), atol=1e-8)


@pytest.mark.parametrize("length", LENGTHS)
def test_right_jacobian_inverse_is_its_inverse(length: float) -> None:
    w = of_length(length)
    np.testing.assert_allclose(so3.right_jacobian_inverse(w) @ so3.right_jacobian(w), np.eye(3), atol=1e-11)


@given(arrays(np.float64, (4, 3), elements=st.floats(-2.0, 2.0)))
def test_a_stack_of_vectors_gives_what_single_ones_give(w: np.ndarray) -> None:
    for f in (so3.hat, so3.exp, so3.right_jacobian, so3.right_jacobian_inverse):
        np.testing.assert_allclose(f(w), np.stack([f(v) for v in w]), rtol=1e-12, atol=1e-14)
