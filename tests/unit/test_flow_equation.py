"""The linear solver (Eq. 15) and the compression of a batch."""

import numpy as np

from velod.geometry.camera import motion_field_rows
from velod.geometry.so3 import exp
from velod.optimizer.batch_fit import Fit, solve, solve_weighted, turn_sensitivity
from velod.optimizer.bins import BIN_NS, Bins, compress
from velod.optimizer.flow_equation import (
    MODEL_SIGMA_PX_S,
    PREDICTED_SHARE,
    Measured,
    Rows,
    body_rows,
    less_known,
    pairs,
    sigmas,
)


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


def test_compression_loses_nothing_of_velocity_bias_and_common_errors():
    """The bins add up to the normal equations of all rows."""
    rng = np.random.default_rng(8)
    rows = rows_of(np.array([2.0, -1.0, 1.0]), np.array([0.02, 0.01, -0.03]), rng)
    fit = solve(rows, 64, 1)
    c = rng.normal(size=(len(rows.z), 3)) * 50
    bins = compress(rows, c, fit, shared_error=2.0, slope=np.zeros(3))
    J = np.hstack([rows.a, -rows.b, c]) * (np.sqrt(fit.weight / 2.0) / rows.sigma / fit.scale)[:, None]
    weighted_z = rows.z * np.sqrt(fit.weight / 2.0) / rows.sigma / fit.scale
    assert bins.count == 4
    assert np.allclose(bins.L.sum(axis=0), J.T @ J, rtol=1e-9)
    assert np.allclose(bins.eta.sum(axis=0), J.T @ weighted_z, rtol=1e-9)
    first_bin = rows.t_ns < 5_000_000
    w = (fit.weight / rows.sigma**2)[first_bin]
    assert np.isclose(bins.t_ns[0], (w @ rows.t_ns[first_bin]) / w.sum(), atol=1)


def test_rows_are_taken_to_the_mean_time_of_their_bin_along_the_slope():
    """e falls by 0.05 m/s within a bin: two batches of exact rows, compressed and added, still determine it."""
    rng = np.random.default_rng(3)
    e, slope, whole = np.array([1.0, -2.0, 0.5]), np.array([3.0, -9.0, 2.0]), Bins(0, 1)
    for _ in range(2):
        rows = rows_of(np.zeros(3), np.zeros(3), rng, m=30)
        t_ns = rows.t_ns % BIN_NS
        z = np.sum(rows.a * (e + slope * t_ns[:, None] * 1e-9), axis=1)
        rows = Rows(t_ns, z, rows.a, rows.b, rows.sigma)
        fit = Fit(e, np.eye(3), np.ones(30), 1.0, 1.0)
        whole.add(compress(rows, np.zeros((30, 3)), fit, 1.0, slope), 1, slope)
    found = np.linalg.solve(whole.L[0, :3, :3], whole.eta[0, :3])
    assert np.allclose(found, e + slope * whole.t_ns[0] * 1e-9, atol=1e-7)


def test_bins_add_to_those_of_the_same_number_and_to_no_others():
    whole, part = Bins(10, 6), Bins(8, 5)
    part.L[:], part.eta[:], part.total[:] = 1.0, 2.0, 3.0
    whole.add(part, 12, np.zeros(3))
    assert [whole.L[k, 0, 0] for k in range(6)] == [1.0, 1.0, 0.0, 0.0, 0.0, 0.0]
    assert whole.eta[1, 3] == 2.0 and whole.total[0, 1] == 3.0
    whole.add(part, 9, np.zeros(3))
    assert whole.L.sum() == 2 * 81


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


def measured(speed, translational):
    one = np.ones(1)
    return Measured(speed * one, 0.03 * speed * one, translational * one, 0.1 * one)


def test_the_depths_sigma_counts_with_the_translational_flow():
    far, near = (sigmas(measured(100.0, t), np.zeros(1)) for t in (0.0, 100.0))
    assert np.isclose(near[0] ** 2 - far[0] ** 2, 10.0**2)


def test_a_flow_that_came_out_too_fast_has_the_sigma_of_the_flow_that_it_should_have_been():
    too_fast = sigmas(measured(120.0, 70.0), np.full(1, 20.0))
    right = sigmas(measured(100.0, 50.0), np.zeros(1))
    assert np.isclose(too_fast[0], right[0])


def test_weights_that_follow_the_noise_of_the_flow_would_bias_the_velocity():
    """The reason for the second fit: 6 % noise on every flow, and a sigma proportional to what was measured."""
    rng = np.random.default_rng(0)
    v, m = np.array([2.0, 1.0, -1.0]), 4000
    a = rng.normal(size=(m, 3)) * 80
    true = a @ v
    a, true = a * np.sign(true)[:, None], np.abs(true)
    keep = true > 30
    a, true = a[keep], true[keep]
    speed = true * (1 + 0.06 * rng.normal(size=len(true)))
    said = Measured(speed, 0.06 * speed, speed, np.full(len(true), 1e-3))

    rows = Rows(np.arange(len(true)), speed, a, np.zeros_like(a), sigmas(said, np.zeros(len(true))))
    naive = solve(rows, 64, 1).e @ v / (v @ v) - 1
    second = solve_weighted(rows, said, 64, 1).e @ v / (v @ v) - 1
    assert naive < -0.003
    assert abs(second) < 0.002


def test_pairs_are_the_intersection_of_both_indices():
    rng = np.random.default_rng(3)
    a, b = (np.sort(rng.choice(500, n, replace=False)).astype(np.uint16) for n in (300, 220))
    _, at_a, at_b = np.intersect1d(a, b, assume_unique=True, return_indices=True)
    i, j = pairs(a, b)
    assert np.array_equal(i, at_a) and np.array_equal(j, at_b)
    assert [len(k) for k in pairs(a, b[:0])] == [0, 0]


def test_rows_in_the_body_frame_are_those_of_plain_matrix_algebra():
    rng = np.random.default_rng(5)
    m, f4, camera = 50, np.float32, (230.0, 170.0, 130.0)
    xy, inv_depth = rng.uniform(0, 300, (2, m)).astype(f4), rng.uniform(0.1, 1.0, m).astype(f4)
    angle = rng.uniform(0, 2 * np.pi, m)
    n = np.column_stack([np.cos(angle), np.sin(angle)]).astype(f4)
    R_CB, p_BC_B = exp(rng.normal(size=3)), rng.normal(size=3)
    a, b = body_rows((xy[0], xy[1]), n, inv_depth, camera, R_CB, p_BC_B)
    nA, nB = motion_field_rows(xy[0], xy[1], *camera, n)
    assert np.allclose(a, inv_depth[:, None] * nA @ R_CB, rtol=1e-6, atol=1e-9)
    assert np.allclose(b, nB @ R_CB + np.cross(p_BC_B, a), rtol=1e-6, atol=1e-9)


def test_sigmas_are_those_of_plain_algebra():
    rng = np.random.default_rng(7)
    speed, sigma, translational, share = rng.uniform(1, 300, (4, 60)) * [[1.0], [0.1], [0.7], [1e-4]]
    residual = rng.normal(size=60) * 100
    predicted = np.clip((speed - residual) / speed, *PREDICTED_SHARE)
    twin = np.sqrt((sigma * predicted) ** 2 + MODEL_SIGMA_PX_S**2 + ((translational - residual) * share) ** 2)
    assert np.allclose(sigmas(Measured(speed, sigma, translational, share), residual), twin, rtol=1e-12)


def test_rows_less_what_is_known_are_solved_by_the_rest():
    """z made of e = known + rest, falling along the slope, and of common errors: what is left is a . rest."""
    rng = np.random.default_rng(8)
    rows, c = rows_of(np.zeros(3), np.zeros(3), rng, m=50), rng.normal(size=(50, 3))
    common, slope, known, rest = rng.normal(size=(4, 3))
    e = known + rest + np.outer((rows.t_ns - 7_000_000) * 1e-9, slope)
    rows = Rows(rows.t_ns, np.sum(rows.a * e, axis=1) + c @ common, rows.a, rows.b, rows.sigma)
    left = less_known(rows, c, common, slope, known, 7_000_000)
    assert np.allclose(left.z, rows.a @ rest, atol=1e-9) and left.sigma is rows.sigma


def test_what_an_error_of_the_angular_velocity_does_to_a_fit_is_a_central_difference():
    rng = np.random.default_rng(4)
    rows = rows_of(np.array([1.0, 2.0, -3.0]), np.zeros(3), rng)
    fit = solve(rows, 64, 1)
    w = fit.weight / rows.sigma**2

    def fitted(n):
        """Least squares with the weights of the fit."""
        aw = rows.a.T * w
        return np.linalg.solve(aw @ rows.a, aw @ (rows.z + rows.b @ n))

    h = 1e-4
    numeric = np.column_stack([(fitted(d) - fitted(-d)) / (2 * h) for d in np.eye(3) * h])
    assert np.allclose(turn_sensitivity(rows, fit), numeric, rtol=1e-5, atol=1e-9)
