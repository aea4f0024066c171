"""The linear solver (Eq. 15) and the compression of a batch."""

import numpy as np

from velod.geometry.so3 import exp
from velod.optimizer.flow_equation import Rows, body_rows, compress, sigmas, solve


def rows_of(v, b_w, rng, m=200, outliers=0.0, sigma=2.0):
    a, b = rng.normal(size=(m, 3)) * 80, rng.normal(size=(m, 3)) * 200
    z = a @ v - b @ b_w + rng.normal(size=m) * sigma
    bad = rng.random(m) < outliers
    z[bad] += rng.uniform(100, 600, int(bad.sum()))
    return Rows(rng.integers(0, 20_000_000, m), z, a, b, np.full(m, sigma))


def test_the_linear_solver_finds_the_velocity_among_40_percent_outliers():
    v = np.array([3.0, -1.0, 0.5])
    fit = solve(rows_of(v, np.zeros(3), np.random.default_rng(0), outliers=0.4), iterations=64, seed=1)
    assert fit is not None
    assert np.linalg.norm(fit.e - v) < 0.02
    assert 0.5 < fit.inliers < 0.65


def test_without_outliers_it_is_weighted_least_squares():
    rng = np.random.default_rng(4)
    rows = rows_of(np.array([1.0, 2.0, -3.0]), np.zeros(3), rng)
    fit = solve(rows, 64, 1)
    w = np.sqrt(fit.weight) / rows.sigma
    twin = np.linalg.lstsq(rows.a * w[:, None], rows.z * w, rcond=None)[0]
    assert np.allclose(fit.e, twin, atol=1e-4)
    H = (rows.a * (w**2)[:, None]).T @ rows.a
    assert np.allclose(fit.cov, np.linalg.inv(H) * fit.scale**2, rtol=1e-6)


def test_parallel_edges_on_one_plane_do_not_determine_a_velocity():
    rng = np.random.default_rng(0)
    rows = rows_of(np.array([1.0, 0.0, 0.0]), np.zeros(3), rng)
    flat = Rows(rows.t_ns, rows.z, np.outer(rng.normal(size=200), [1.0, 0.0, 0.0]), rows.b, rows.sigma)
    assert solve(flat, 64, 1) is None


def test_two_rows_are_not_enough():
    rows = rows_of(np.ones(3), np.zeros(3), np.random.default_rng(0), m=2)
    assert solve(rows, 64, 1) is None


def test_the_same_seed_gives_the_same_bits():
    rows = rows_of(np.ones(3), np.zeros(3), np.random.default_rng(2), outliers=0.3)
    assert np.array_equal(solve(rows, 64, 9).e, solve(rows, 64, 9).e)


def test_compression_loses_nothing_of_velocity_and_bias():
    """The bins add up to the normal equations of all rows, when the gyroscope is perfect."""
    rng = np.random.default_rng(8)
    rows = rows_of(np.array([2.0, -1.0, 1.0]), np.array([0.02, 0.01, -0.03]), rng)
    fit = solve(rows, 64, 1)
    infos = compress(rows, fit, bin_ns=5_000_000, gyro_noise=1e-9, shared_error=1.0)
    J = np.hstack([rows.a, -rows.b]) * (np.sqrt(fit.weight) / rows.sigma / fit.scale)[:, None]
    assert len(infos) == 4
    assert np.allclose(sum(i.L for i in infos), J.T @ J, rtol=1e-6, atol=1e-6)
    assert all(np.min(rows.t_ns) <= i.t_ns <= np.max(rows.t_ns) for i in infos)


def test_the_gyroscopes_noise_is_marginalised_as_dense_algebra_does():
    rng = np.random.default_rng(8)
    rows = rows_of(np.ones(3), np.zeros(3), rng)
    one_bin = Rows(rows.t_ns % 5_000_000, rows.z, rows.a, rows.b, rows.sigma)
    fit = solve(one_bin, 64, 1)
    (info,) = compress(one_bin, fit, 5_000_000, gyro_noise=1.86e-3, shared_error=5.0)
    # dense: z = [a, -b] x - b n_w + noise: correlated noise of all rows
    w = fit.weight > 0
    W_inv = np.diag(((rows.sigma * fit.scale) ** 2 / np.maximum(fit.weight, 1e-300) * 5.0)[w])
    b = rows.b[w]
    covariance = W_inv + b @ b.T * 1.86e-3**2 / 5e-3
    J = np.hstack([rows.a, -rows.b])[w]
    assert np.allclose(info.L, J.T @ np.linalg.solve(covariance, J), rtol=1e-5, atol=1e-6)
    assert np.allclose(info.eta, J.T @ np.linalg.solve(covariance, rows.z[w]), rtol=1e-5, atol=1e-5)


def test_the_rows_of_a_displaced_and_turned_camera_are_differences_of_its_flow():
    """Eq. 4 with R_CB and the lever arm, against differences of a projected point."""
    R_CB, p_BC_B = exp(np.array([0.3, -0.2, 0.5])), np.array([0.1, -0.05, 0.2])
    v_B, w_B, f, cx, cy, Z = np.array([1.0, -2.0, 0.5]), np.array([0.7, 1.1, -0.4]), 230.0, 170.0, 130.0, 3.0
    x, y, n = np.array([200.0]), np.array([90.0]), np.array([[0.6, 0.8]])
    f4 = np.float32
    a, b = body_rows((x.astype(f4), y.astype(f4)), n.astype(f4), np.array([1 / Z], f4), (f, cx, cy), R_CB, p_BC_B)
    P_C = np.array([(x[0] - cx) / f * Z, (y[0] - cy) / f * Z, Z])
    P_0 = R_CB.T @ P_C + p_BC_B  # a fixed point, in the body frame of t = 0

    def project(t):
        P_B = exp(w_B * t).T @ (P_0 - v_B * t)
        P = R_CB @ (P_B - p_BC_B)
        return np.array([f * P[0] / P[2] + cx, f * P[1] / P[2] + cy])

    h = 1e-6
    flow = (project(h) - project(-h)) / (2 * h)
    assert np.allclose(a @ v_B + b @ w_B, n @ flow, rtol=1e-5)


def test_the_depths_sigma_counts_with_the_translational_flow():
    one, f4 = np.ones(1, np.float32), np.float32
    far = sigmas(one, np.array([0.5], f4), np.array([0.05], f4), np.array([0.0]))
    near = sigmas(one, np.array([0.5], f4), np.array([0.05], f4), np.array([100.0]))
    assert np.isclose(near[0] ** 2 - far[0] ** 2, 10.0**2, rtol=1e-5)
