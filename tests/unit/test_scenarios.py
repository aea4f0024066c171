"""A sensor breaks, or the world goes dark: what the optimizer makes of it. Each test says what is expected."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.synthetic import CALIBRATION, FLIGHT, G_W, REST, Motion, errors, messages, silent, with_imu
from velod.config import from_tree
from velod.geometry.so3 import exp
from velod.optimizer.spikes import mend_spikes
from velod.optimizer.stage import OptimizerStage
from velod.types import DepthBatch, ImuSamples, Velocity

SECONDS = 2.0
USUAL_ERROR = 0.045
"""m/s; the flight without a fault has a mean of 0.015 to 0.03 and stays below this."""
STEADY = Motion(np.zeros(3), np.array([2.0, 0.5, 0.2]), np.zeros(3), np.ones(3))


class Falling(Motion):
    """In free fall: the accelerometer hears nothing."""

    def v_B(self, t):
        return self.R_WB(t).T @ (self.v0_W - G_W * t)

    def accel(self, t):
        return np.zeros(3)


class UpsideDown(Motion):
    def R_WB(self, t):
        return exp(np.array([-1.3, 0.3, -0.2])) @ exp(self.w_B * t)


class Passed(Motion):
    """What the flows tell while something fills the view that sets out at 1 s, to 1.2 m/s, and is gone at 2 s."""

    def v_B(self, t):
        share = np.clip((t - 1.0) / 0.3, 0.0, 1.0) if t < 2.0 else 0.0
        return super().v_B(t) - self.R_WB(t).T @ np.array([0.0, 1.2 * share, 0.0])


def run(stream, calibration=CALIBRATION, **optimizer):
    stage = OptimizerStage(from_tree({"optimizer": optimizer}), calibration)
    return [v for m in stream for v in stage.handle(m) if isinstance(v, Velocity)], stage


def between(velocities, from_s, to_s):
    return [v for v in velocities if from_s * 1e9 < v.t_ns <= to_s * 1e9]


def sigma(v):
    return float(np.sqrt(np.linalg.eigvalsh(v.cov)[-1]))


def nees(velocities, motion):
    d = [(v.v_B - motion.v_B(v.t_ns * 1e-9), v.cov) for v in velocities if v.valid]
    return np.array([e @ np.linalg.solve(cov, e) for e, cov in d])


def delayed(stream, from_s, by_s):
    """Sensor time jumps forward."""
    by_ns = int(by_s * 1e9)
    for m in stream:
        if m.t_ns <= from_s * 1e9:
            yield m
        elif isinstance(m, ImuSamples):
            at = m.sample_t_ns
            at = np.where(at > from_s * 1e9, at + by_ns, at)
            moved = {"event_t_ns": m.event_t_ns + by_ns, "batch_t_ns": m.batch_t_ns + by_ns, "sample_t_ns": at}
            yield replace(m, t_ns=m.t_ns + by_ns, **moved)
        else:
            yield replace(m, t_ns=m.t_ns + by_ns)


def test_a_gyroscope_that_dies_is_noticed_within_100_ms_and_nothing_wrong_is_called_valid():
    """The flows contradict an IMU that does not turn: degraded with a covariance that covers it, then lost."""
    stream = with_imu(messages(FLIGHT, SECONDS), lambda t, a, w: (a, np.where(t[:, None] > 1.0, 0.0, w)))
    velocities, _ = run(stream)
    for v in between(velocities, 1.1, 1.2):
        assert v.state in ("degraded", "lost") and "disagree" in v.reason
    assert not any(v.valid for v in between(velocities, 1.25, SECONDS))
    assert nees(between(velocities, 1.05, 1.25), FLIGHT).mean() < 30.0


def test_a_spike_of_the_accelerometer_does_not_reach_the_velocity():
    """One sample of 100 m/s^2 is 0.5 m/s once integrated; it is mended, counted, and nothing else happens."""

    def spike(t, a, w):
        a[np.abs(t - 1.5) < 1e-6] += [100.0, 0.0, 0.0]
        return a, w

    velocities, stage = run(with_imu(messages(FLIGHT, SECONDS), spike))
    assert stage.counters["imu.spike"] == 1
    after = between(velocities, 1.52, SECONDS)
    assert {v.state for v in after} == {"tracking"}
    assert errors(after, FLIGHT).max() < USUAL_ERROR + 0.02


def test_vibration_is_not_mended():
    t = np.arange(200) / 200.0
    shaking = np.outer(np.sin(2 * np.pi * 60.0 * t), [60.0, 20.0, 0.0])
    assert mend_spikes(shaking.copy(), 25.0, 0, 200) == 0
    glitch = np.zeros((20, 3))
    glitch[7] = [0.0, 80.0, 0.0]
    assert mend_spikes(glitch, 25.0, 0, 20) == 1
    assert not glitch.any()


def test_a_gap_of_200_ms_in_the_imu_starts_the_estimate_anew():
    """Nobody knows how the sensor turned meanwhile: lost, and valid again within 0.1 s of the gap's end."""
    holed = []
    for m in messages(FLIGHT, SECONDS):
        if isinstance(m, ImuSamples):
            kept = (m.sample_t_ns <= 1.4e9) | (m.sample_t_ns >= 1.6e9)
            m = replace(m, sample_t_ns=m.sample_t_ns[kept], accel=m.accel[kept], gyro=m.gyro[kept])
        holed.append(m)
    velocities, stage = run(holed)
    assert stage.counters["imu.gap_restart"] == 1
    after = between(velocities, 1.6, SECONDS)
    assert after[0].state == "lost" and not after[0].valid
    assert next(v.t_ns for v in after if v.valid) < 1.7e9
    assert errors(between(velocities, 1.7, SECONDS), FLIGHT).mean() < USUAL_ERROR
    assert nees(after, FLIGHT).mean() < 4.0


@pytest.mark.parametrize("empty_batches", [True, False])
def test_without_events_for_a_second_the_imu_carries_on_and_the_way_back_is_no_jump(empty_batches):
    """Degraded while dark, covered by a growing covariance; the first flows move the estimate within it."""
    dark = messages(FLIGHT, 2.4, dark=(1.0, 2.0))
    velocities, _ = run(dark if empty_batches else silent(dark, 1.0, 2.0))
    gone = between(velocities, 1.15, 2.0)
    assert {v.state for v in gone} == {"degraded"} and all(v.valid for v in gone)
    assert all(sigma(b) > sigma(a) for a, b in pairwise(gone[::8]))
    assert nees(gone, FLIGHT).mean() < 9.0
    back = between(velocities, 2.0, 2.4)
    assert back[-1].state == "tracking" and errors(back[4:], FLIGHT).max() < USUAL_ERROR + 0.02
    jump = [
        (b.v_B - FLIGHT.v_B(b.t_ns * 1e-9)) - (a.v_B - FLIGHT.v_B(a.t_ns * 1e-9)) for a, b in pairwise(velocities)
    ]
    at = [i for i, v in enumerate(velocities[1:]) if 1.99e9 < v.t_ns < 2.1e9]
    assert max(float(np.linalg.norm(jump[i])) for i in at) < 3.0 * sigma(gone[-1])


def without_depths(stream, from_s, to_s):
    """The right camera sees nothing meanwhile."""
    return [
        replace(m, index=m.index[:0], disparity=m.disparity[:0], inv_depth=m.inv_depth[:0], sigma=m.sigma[:0],
                refined=m.refined[:0])
        if isinstance(m, DepthBatch) and from_s * 1e9 < m.t_ns <= to_s * 1e9 else m
        for m in stream
    ]  # fmt: skip


def test_without_the_right_camera_the_estimate_is_carried_by_the_imu_and_says_why():
    """No depth, no scale: degraded for want of depths, covered by the covariance; tracking once it is back."""
    velocities, _ = run(without_depths(messages(FLIGHT, SECONDS), 1.0, 1.6))
    gone = between(velocities, 1.15, 1.6)
    assert all(v.state == "degraded" and "0 depths of 250 events" in v.reason for v in gone)
    assert nees(gone, FLIGHT).mean() < 9.0
    assert velocities[-1].state == "tracking"
    assert errors(between(velocities, 1.65, SECONDS), FLIGHT).max() < USUAL_ERROR + 0.02


def test_cameras_that_see_the_same_for_a_moment_only_are_not_believed():
    """A right camera that is late finds its own past for some tenths of a second after a start: wrong matches."""
    velocities, _ = run(without_depths(without_depths(messages(FLIGHT, 1.6), 0.0, 0.1), 0.6, 0.7))
    assert not any(v.valid for v in between(velocities, 0.0, 1.45))
    assert any("did not see the same" in v.reason for v in between(velocities, 0.2, 0.6))
    assert all(v.valid for v in between(velocities, 1.52, 1.6))
    # the first batch of noisy events may have few depths in any cameras
    velocities, _ = run(without_depths(messages(FLIGHT, 0.4), 0.0, 0.03))
    assert all(v.valid for v in between(velocities, 0.2, 0.4))


@pytest.mark.parametrize("by_s", [0.3, 5.0])
def test_a_jump_of_the_clock_starts_the_estimate_anew(by_s):
    """All sensors jump together: lost for a moment, valid again within 0.1 s, and right."""
    velocities, stage = run(delayed(messages(FLIGHT, SECONDS), 1.4, by_s))
    assert stage.counters["imu.gap_restart"] == 1
    after = between(velocities, 1.4 + by_s, SECONDS + by_s)
    assert next(v.t_ns for v in after if v.valid) < (1.5 + by_s) * 1e9
    right = [np.linalg.norm(v.v_B - FLIGHT.v_B(v.t_ns * 1e-9 - by_s)) for v in after if v.valid]
    assert np.mean(right) < USUAL_ERROR


@pytest.mark.parametrize("motion", [FLIGHT, STEADY])
def test_a_view_full_of_what_moves_by_itself_is_told_from_the_surroundings(motion):
    """0.2 s after it has set out: degraded or lost, the truth within what is told, and the way back is short."""
    passed = Passed(motion.w_B, motion.v0_W, motion.amplitude, motion.rate)
    velocities, _ = run(messages(passed, 3.0))
    meanwhile = between(velocities, 1.2, 2.0)
    assert not any(v.state == "tracking" for v in meanwhile)
    assert any("does the scene move" in v.reason for v in meanwhile)
    off = [(v.v_B - motion.v_B(v.t_ns * 1e-9), v.cov) for v in meanwhile]
    assert np.mean([e @ np.linalg.solve(cov, e) for e, cov in off]) < 6.0
    assert velocities[-1].state == "tracking"
    assert errors(between(velocities, 2.8, 3.0), motion).max() < 2 * USUAL_ERROR


def test_times_before_zero_are_times_as_any():
    """A recording whose clock is zero at its trigger: the same states at the same moments, as accurate."""
    usual, _ = run(messages(FLIGHT, 1.5))
    before, stage = run(delayed(messages(FLIGHT, 1.5), -1.0, -1.2))
    assert [(v.t_ns + 1_200_000_000, v.state) for v in before] == [(v.t_ns, v.state) for v in usual]
    assert np.allclose([v.v_B for v in before], [v.v_B for v in usual], atol=0.05)
    assert "imu.backwards" not in stage.counters


def test_cameras_mounted_otherwise_than_the_calibration_says_are_noticed():
    """T_cam_imu wrong by 90 degrees: never valid. By 10: mostly not called tracking, though nothing else tells."""
    for degrees, most_tracking in ((90.0, 0.0), (10.0, 0.35)):
        T_cam_imu = np.eye(4)
        T_cam_imu[:3, :3] = exp(np.array([0.0, np.radians(degrees), 0.0]))
        velocities, _ = run(messages(FLIGHT, SECONDS), replace(CALIBRATION, T_cam_imu=T_cam_imu))
        assert np.mean([v.state == "tracking" for v in velocities]) <= most_tracking


def test_a_sensor_upside_down_is_as_good_as_any():
    motion = UpsideDown(FLIGHT.w_B, FLIGHT.v0_W, FLIGHT.amplitude, FLIGHT.rate)
    velocities, _ = run(messages(motion, 1.2))
    assert next(v.t_ns for v in velocities if v.valid) < 0.15e9
    assert errors(between(velocities, 0.3, 1.2), motion).mean() < USUAL_ERROR
    up = motion.R_WB(velocities[-1].t_ns * 1e-9).T @ [0.0, 0.0, 1.0]
    assert np.degrees(np.arccos(velocities[-1].up_B @ up)) < 3.0


def test_a_start_in_free_fall_is_valid_within_100_ms():
    motion = Falling(np.array([0.5, 0.8, -0.3]), np.array([1.0, 2.0, 6.0]), np.zeros(3), np.ones(3))
    velocities, _ = run(messages(motion, 0.8))
    assert next(v.t_ns for v in velocities if v.valid) <= 0.1e9
    assert errors(velocities, motion).max() < 0.1


def test_biases_ten_times_larger_than_specified_are_found():
    """0.87 m/s^2 and 0.087 rad/s instead of 0.05 and 0.005: the usual error after half a second."""
    b_a, b_w = np.array([0.5, -0.5, 0.5]), np.array([0.05, -0.05, 0.05])
    velocities, stage = run(with_imu(messages(FLIGHT, SECONDS), lambda t, a, w: (a + b_a, w + b_w)))
    assert errors(between(velocities, 0.5, SECONDS), FLIGHT).mean() < USUAL_ERROR
    assert np.linalg.norm(stage._estimator.head.b_w - b_w) < 0.25 * np.linalg.norm(b_w)


def test_biases_beyond_their_specification_are_in_the_covariance_from_the_first_velocity_on():
    """Six sigmas in every axis: the prior gives way as soon as the flows contradict it, and nothing begins anew."""
    squared = []
    for signs in ([1, -1, 1], [-1, 1, 1], [1, 1, -1]):
        b_a, b_w = 0.3 * np.array(signs), 0.03 * np.array(signs[::-1])
        velocities, _ = run(with_imu(messages(FLIGHT, 1.0), lambda t, a, w, b_a=b_a, b_w=b_w: (a + b_a, w + b_w)))
        assert all(v.valid for v in velocities if v.t_ns > 0.15e9)
        squared.append(nees(velocities, FLIGHT))
    assert np.concatenate(squared).mean() < 4.0


def test_the_prior_of_the_biases_stays_as_specified_where_that_is_asked_for():
    b_a, b_w = np.full(3, 0.3), np.full(3, 0.03)
    for widen in (True, False):
        stream = with_imu(messages(FLIGHT, 0.6), lambda t, a, w: (a + b_a, w + b_w))
        _, stage = run(stream, widen_bias_prior=widen)
        assert bool(stage._estimator.counters.get("bias.prior_changed")) == widen


def test_an_accelerometer_in_g_gives_no_velocity():
    """What is taken for its bias cannot be one: not valid, and why, a quarter of a second after the start."""
    for motion in (FLIGHT, STEADY):
        velocities, _ = run(with_imu(messages(motion, 1.0), lambda t, a, w: (a / 9.81, w)))
        later = between(velocities, 0.25, 1.0)
        assert not any(v.valid for v in later)
        assert any("in g" in v.reason for v in later)


def test_sixty_seconds_at_rest():
    """No event at all after the first second: within 5 mm/s throughout, and the biases converge."""
    b_a, b_w = np.array([0.08, -0.05, 0.1]), np.array([0.008, -0.006, 0.004])
    stream = with_imu(silent(messages(REST, 60.0, dark=(0.0, 99.0)), 1.0), lambda t, a, w: (a + b_a, w + b_w))
    velocities, stage = run(stream, output_hz=10.0)
    rest = [v for v in velocities if v.t_ns > 1e9]
    assert len(rest) > 580 and {v.state for v in rest} == {"tracking"}
    assert errors(rest, REST).max() < 5e-3
    head = stage._estimator.head
    # the walk over the time that an average of the noise takes: a milliradian per second
    assert np.abs(head.b_w - b_w).max() < 2e-3
    # an accelerometer's bias across gravity is no different from a tilt
    assert abs((head.b_a - b_a) @ (REST.R_WB(0.0).T @ [0.0, 0.0, 1.0])) < 0.05


@pytest.mark.parametrize("speed", [1.0, 0.1])
def test_a_covered_lens_in_steady_flight_is_not_taken_for_rest(speed):
    """No event and a quiet IMU, but the velocity was known when the events ceased: dark, not at rest."""
    motion = replace(STEADY, v0_W=STEADY.v0_W * speed)
    velocities, stage = run(silent(messages(motion, 2.6, dark=(0.8, 2.2)), 1.0, 2.2))
    assert "standstill" not in stage.counters
    covered = between(velocities, 1.5, 2.2)
    assert all(v.state == "degraded" and "dark or covered" in v.reason for v in covered)
    assert nees(covered, motion).mean() < 9.0
    assert velocities[-1].state == "tracking"
