"""The cubic B-spline against scipy's."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from velod.optimizer.spline import basis, locate


@pytest.mark.parametrize("u", [0.0, 0.1, 0.5, 0.99, 1.0])
def test_the_basis_is_that_of_scipy(u):
    knots = np.arange(-3.0, 5.0)
    scipy_basis = [BSpline.basis_element(knots[i : i + 5], extrapolate=False)(u + 0.0) for i in range(4)]
    assert np.allclose(basis(u), np.nan_to_num(scipy_basis), atol=1e-14)


def test_segments_and_control_points_evaluate_the_spline_of_scipy():
    rng = np.random.default_rng(3)
    knot_ns, n_ctrl = 100_000_000, 9
    c = rng.normal(size=(n_ctrl, 3))
    reference = BSpline(np.arange(-3, n_ctrl + 1) * 0.1, c, 3)
    for t_ns in rng.integers(0, (n_ctrl - 3) * knot_ns, 50):
        k, u = locate(int(t_ns), knot_ns)
        assert np.allclose(basis(u) @ c[k : k + 4], reference(t_ns * 1e-9), atol=1e-12)
