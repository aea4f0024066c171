"""The baselines and the floor: each does what its name says on data where the answer is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from velod.config import Settings, from_tree, to_tree
from velod.eval.baselines import benosman_settings, integrate_imu, paper_settings, solve_linear
from velod.eval.dead_reckoning import attitude_at, dead_reckoning
from velod.eval.floor import with_perfect_flow_and_depth
from velod.eval.front_end import FrontEnd, SecondFlow, joined
from velod.eval.imu_alone import imu_alone
from velod.eval.metrics import evaluate, truth_at
from velod.geometry.camera import motion_field_rows
from velod.geometry.so3 import exp
from velod.io.model import Imu, Truth
from velod.sim import sequence
from velod.sim.imu import sample_imu
from velod.sim.run import true_motion
from velod.types import DepthBatch, EventBatch, FlowBatch, ImuSamples, Velocity

SECONDS = 2.0
RECIPE = sequence("boxes-4")
TRUTH = true_motion(RECIPE.trajectory, SECONDS)
CLEAN = sample_imu(RECIPE.trajectory, RECIPE.imu.noiseless(), SECONDS, np.random.default_rng(0))
CALIBRATION = RECIPE.calibration


def batch(seq: int, *, t_ns: int = 500_000_000, m: int = 60, v: np.ndarray | None = None) -> tuple:
    """Flow and depth of one moment (age 1 ns) that obey Eq. 4 for ``v`` (the true velocity unless given)."""
    rng = np.random.default_rng(seq)
    x, y = (rng.uniform(20, size - 20, m).astype(np.float32) for size in (346, 260))
    angle = rng.uniform(0, 2 * np.pi, m)
    n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inverse = rng.uniform(0.2, 1.0, m)
    at = np.array([t_ns - 1])
    v = truth_at(TRUTH, at)[0] if v is None else v
    w = RECIPE.trajectory.at(at * 1e-9).omega_B[0]
    camera = CALIBRATION.left
    nA, nB = motion_field_rows(x, y, camera.fx, camera.cx, camera.cy, n)
    speed = nA @ v * inverse + nB @ w
    index = np.arange(m, dtype=np.uint16)
    one = np.ones(m, np.float32)
    flow = FlowBatch(
        seq, t_ns, m, index, np.ones(m, np.uint32), x, y, n.astype(np.float32), speed.astype(np.float32), one
    )
    f_b = np.float32(camera.fx * -CALIBRATION.t_RL[0])
    inv_depth = inverse.astype(np.float32)
    depth = DepthBatch(seq, t_ns, m, index, f_b * inv_depth, inv_depth, 1e-3 * inv_depth, np.ones(m, np.uint8))
    return flow, depth


def imu_samples(imu: Imu) -> ImuSamples:
    end = int(imu.t_ns[-1])
    return ImuSamples(0, end, end, 0, end, imu.t_ns, imu.accel, imu.gyro)


def front_end(*messages: object) -> FrontEnd:
    return FrontEnd([imu_samples(CLEAN), *messages])  # type: ignore[list-item]


def velocity(t_ns: int, v_B: np.ndarray, valid: bool = True) -> Velocity:
    return Velocity(0, t_ns, v_B, np.eye(3), valid, "tracking", "", 0, t_ns)


# --- the IMU alone ---


def test_a_clean_imu_from_the_true_start_integrates_to_the_truth() -> None:
    metrics = evaluate(integrate_imu(CLEAN, TRUTH, Settings()), TRUTH)
    assert metrics.n == 151  # 75 Hz over 2 s, both ends
    assert metrics.max_mps < 2e-3


def test_a_noisy_imu_drifts_away_from_the_truth() -> None:
    noisy = sample_imu(RECIPE.trajectory, RECIPE.imu, SECONDS, np.random.default_rng(1))
    early, late = (
        evaluate([v for v in integrate_imu(noisy, TRUTH, Settings()) if low <= v.t_ns < low + 5e8], TRUTH).ave_mps
        for low in (0, 1_500_000_000)
    )
    assert late > 2.0 * early > 0.0


@pytest.mark.parametrize(
    ("name", "seconds", "low", "high"), [("corridor-1", 90.0, 2.67, 7.83), ("boxes-4", 30.0, 0.4, 1.2)]
)
def test_over_the_papers_length_the_imu_alone_is_as_wrong_as_in_the_paper(
    name: str, seconds: float, low: float, high: float
) -> None:
    """Table II: 2.67 to 7.83 m/s in the corridors, 0.54 and 0.63 among the boxes, from one noise each."""
    recipe = sequence(name)
    truth = true_motion(recipe.trajectory, seconds)
    imus = (sample_imu(recipe.trajectory, recipe.imu, seconds, np.random.default_rng((k, 0))) for k in range(1, 6))
    ave_mps = np.mean([evaluate(integrate_imu(imu, truth, Settings()), truth).ave_mps for imu in imus])
    assert low < ave_mps < high


def test_the_imu_is_not_integrated_where_its_start_is_not_known() -> None:
    late = Truth(TRUTH.t_ns + 1_000_000, TRUTH.v_B, TRUTH.omega_B, TRUTH.q_WB_xyzw)
    with pytest.raises(ValueError, match="truth at the first IMU sample"):
        integrate_imu(CLEAN, late, Settings())


# --- the linear solver alone ---


def test_the_linear_solver_gives_the_true_velocity_at_the_end_of_each_batch() -> None:
    found = solve_linear(front_end(*batch(0), *batch(1, t_ns=600_000_000)), Settings(), CALIBRATION)
    assert [v.t_ns for v in found] == [500_000_000, 600_000_000]
    assert evaluate(found, TRUTH).max_mps < 1e-3


def test_without_outliers_the_linear_solver_agrees_with_least_squares() -> None:
    flow, depth = batch(0)
    noise = np.random.default_rng(5).normal(0.0, 0.5, len(flow.speed)).astype(np.float32)
    flow = replace(flow, speed=flow.speed + noise)
    camera, w = CALIBRATION.left, RECIPE.trajectory.at(np.array([0.5])).omega_B[0]
    nA, nB = motion_field_rows(flow.x, flow.y, camera.fx, camera.cx, camera.cy, flow.n)
    expected = np.linalg.lstsq(nA * depth.inv_depth[:, None], flow.speed - nB @ w, rcond=None)[0]
    found = solve_linear(front_end(flow, depth), Settings(), CALIBRATION)[0]
    # Weights differ: by the depth's sigma, and by the biweight's mild taper.
    np.testing.assert_allclose(found.v_B, expected, atol=0.3 * np.sqrt(np.diag(found.cov)).max() + 1e-4)


def test_the_linear_solver_shrugs_off_a_fifth_of_wrong_flows() -> None:
    flow, depth = batch(0)
    wrong = flow.speed.copy()
    wrong[::5] += 300.0
    found = solve_linear(front_end(replace(flow, speed=wrong), depth), Settings(), CALIBRATION)
    assert evaluate(found, TRUTH).max_mps < 0.01


def test_the_linear_solver_says_nothing_about_a_batch_with_too_few_flows() -> None:
    assert solve_linear(front_end(*batch(0, m=5)), Settings(), CALIBRATION) == []


# --- the front end, kept ---


def test_batches_are_cut_down_to_the_events_with_flow_and_depth() -> None:
    flow, depth = batch(0, m=8)
    kept = [0, 3, 7]
    fewer = replace(
        depth,
        **{name: getattr(depth, name)[kept] for name in ("index", "disparity", "inv_depth", "sigma", "refined")},
    )
    cut_flow, cut_depth = joined(flow, fewer)
    assert cut_flow.index.tolist() == cut_depth.index.tolist() == kept
    np.testing.assert_array_equal(cut_flow.speed, flow.speed[kept])


def test_another_imu_takes_the_place_of_the_recorded_one_and_nothing_else_changes() -> None:
    noisy = sample_imu(RECIPE.trajectory, RECIPE.imu, SECONDS, np.random.default_rng(1))
    flow, depth = batch(0)
    changed = front_end(flow, depth).with_imu(noisy).messages
    assert isinstance(changed[0], ImuSamples)
    np.testing.assert_array_equal(changed[0].gyro, noisy.gyro)
    assert changed[1:] == [flow, depth]


def test_an_imu_sampled_at_other_times_is_refused() -> None:
    with pytest.raises(ValueError, match="other times"):
        front_end().with_imu(Imu(CLEAN.t_ns + 1, CLEAN.accel, CLEAN.gyro))


# --- Benosman-NF ---


def test_benosman_flow_is_the_reciprocal_of_each_component() -> None:
    grad_T = np.array([2e-3, 1e-3])  # s/px: correct flow 1 / |grad_T| along it
    columns, rows = np.meshgrid(np.arange(-2, 3), np.arange(-2, 3))
    age = (50e6 - 1e9 * (grad_T[0] * columns + grad_T[1] * rows)).astype(np.uint32).reshape(1, 25)
    one = np.array([100], np.uint16)
    events = EventBatch(0, 10**9, 0, 1, one, one, age[:, 12].copy(), np.ones(1, np.uint8), age)
    other = SecondFlow(benosman_settings(Settings()), CALIBRATION)
    right = SecondFlow(Settings(), CALIBRATION)
    for worker in (other, right):
        worker.note(events)
    before = FrontEnd([FlowBatch(0, 10**9, 1, *[np.empty(0)] * 7)])  # type: ignore[arg-type]
    wrong_flow, flow = (worker.in_place_of(before).flows[0] for worker in (other, right))
    np.testing.assert_allclose(flow.n[0] * flow.speed[0], grad_T / (grad_T @ grad_T), rtol=1e-4)
    np.testing.assert_allclose(wrong_flow.n[0] * wrong_flow.speed[0], 1.0 / grad_T, rtol=1e-4)


# --- the paper's settings ---


def test_the_papers_settings_are_allowed_and_differ_from_ours_where_the_paper_does() -> None:
    paper = paper_settings(Settings())
    assert from_tree(to_tree(paper)) == paper
    assert (paper.ingest.selection, paper.optimizer.weights, paper.optimizer.spline) == ("paper", "fixed", "velocity")
    assert not paper.depth.refine
    assert paper.imu == Settings().imu


# --- the floor ---


@dataclass(frozen=True)
class KnownDepth:
    """The same depths whatever is asked."""

    z: np.ndarray
    how: str = "known"

    def __call__(self, t_ns: np.ndarray, rays: np.ndarray, shift_m: float = 0.0) -> np.ndarray:
        return np.broadcast_to(self.z[:, None], rays.shape[:2]).astype(np.float64)


def test_perfect_flow_and_depth_are_the_simulators_at_the_measured_positions_and_directions() -> None:
    wrong_flow, wrong_depth = batch(0, v=np.array([9.0, 9.0, 9.0]))
    flow, depth = batch(0)
    perfect = with_perfect_flow_and_depth(
        front_end(wrong_flow, wrong_depth), CALIBRATION, TRUTH, KnownDepth(1.0 / depth.inv_depth)
    )
    got_flow, got_depth = perfect.flows[0], perfect.depths[0]
    np.testing.assert_allclose(got_flow.n * got_flow.speed[:, None], flow.n * flow.speed[:, None], atol=0.01)
    assert (got_flow.speed >= 0.0).all()
    np.testing.assert_allclose(got_depth.disparity, depth.disparity, rtol=1e-5)
    np.testing.assert_array_equal(got_flow.x, wrong_flow.x)


def test_events_whose_true_depth_is_not_known_have_no_part_in_the_floor() -> None:
    flow, depth = batch(0)
    z = 1.0 / depth.inv_depth
    z[:3] = np.nan
    perfect = with_perfect_flow_and_depth(front_end(flow, depth), CALIBRATION, TRUTH, KnownDepth(z))
    np.testing.assert_array_equal(perfect.flows[0].index, flow.index[3:])
    np.testing.assert_array_equal(perfect.depths[0].index, flow.index[3:])


# --- dead reckoning ---


def test_the_true_velocity_dead_reckons_to_the_true_place() -> None:
    t_ns = np.arange(0, 2_000_000_001, 5_000_000)
    found = dead_reckoning(
        [velocity(int(t), v) for t, v in zip(t_ns, truth_at(TRUTH, t_ns), strict=True)], CLEAN, TRUTH
    )
    assert found is not None
    assert found.distance_m == pytest.approx(2.0 * np.linalg.norm(TRUTH.v_B, axis=1).mean(), rel=0.01)
    assert found.drift_percent < 0.05


def test_a_tenth_too_fast_drifts_by_a_tenth_of_the_net_displacement() -> None:
    t_ns = np.arange(0, 2_000_000_001, 5_000_000)
    fast = [velocity(int(t), 1.1 * v) for t, v in zip(t_ns, truth_at(TRUTH, t_ns), strict=True)]
    found = dead_reckoning(fast, CLEAN, TRUTH)
    assert found is not None
    net = np.linalg.norm(found.true_p_WB[-1] - found.true_p_WB[0])
    assert found.drift_percent == pytest.approx(10.0 * net / found.distance_m, rel=0.02)


def test_dead_reckoning_needs_two_velocities_after_the_first_valid_one() -> None:
    still = [velocity(1_000_000, np.zeros(3), valid=False), velocity(2_000_000, np.zeros(3))]
    assert dead_reckoning(still, CLEAN, TRUTH) is None


def test_the_attitude_between_two_samples_lies_on_the_shortest_way() -> None:
    t_ns = 500_500_000
    w = RECIPE.trajectory.at(np.array([t_ns * 1e-9]))
    np.testing.assert_allclose(attitude_at(TRUTH, t_ns), w.R_WB[0], atol=1e-5)
    assert np.linalg.norm(exp(w.omega_B[0] * 5e-4) - np.eye(3)) > 1e-4  # half a sample is no small thing


# --- the IMU alone, over time ---


def test_the_gyroscopes_noise_tilts_gravity_as_theory_says() -> None:
    """A white rate of density s tilts by s sqrt(t); g of it goes into the velocity: g s sqrt(t^3 / 3) for each of
    two axes. This is nine tenths of what the IMU of the paper accumulates in half a minute."""
    seconds, noises = 20.0, 60
    model = replace(RECIPE.imu.noiseless(), gyro_noise=RECIPE.imu.gyro_noise)
    truth = true_motion(RECIPE.trajectory, seconds)
    ends = []
    for k in range(noises):
        imu = sample_imu(RECIPE.trajectory, model, seconds, np.random.default_rng((k, 0)))
        last = integrate_imu(imu, truth, Settings())[-1]
        ends.append(last.v_B - truth_at(truth, np.array([last.t_ns]))[0])
    expected = np.sqrt(2.0) * 9.81 * model.gyro_noise * np.sqrt(seconds**3 / 3.0)
    # The root mean square of 120 numbers is known to 6 %; accelerations of the motion tilt with gravity.
    assert np.sqrt(np.mean(np.sum(np.square(ends), axis=1))) == pytest.approx(expected, rel=0.2)


def test_the_imu_alone_is_judged_up_to_each_moment() -> None:
    noisy = [sample_imu(RECIPE.trajectory, RECIPE.imu, SECONDS, np.random.default_rng(k)) for k in (1, 2, 3)]
    alone = imu_alone(noisy, TRUTH, Settings(), (1.0, 2.0))
    assert alone.ave_mps.shape == (3, 2)
    assert alone.ave_mps[0, 1] == pytest.approx(evaluate(integrate_imu(noisy[0], TRUTH, Settings()), TRUTH).ave_mps)
    assert (alone.ave_mps[:, 0] < alone.ave_mps[:, 1]).all()
    np.testing.assert_allclose(alone.share_below(float(np.sort(alone.ave_mps[:, 1])[1]) + 1e-9)[1], 2 / 3)
