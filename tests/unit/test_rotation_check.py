"""Events late against the IMU, and cameras turned against their calibration: found, alarmed, and the clock mended."""

from dataclasses import replace

import numpy as np
import pytest

from tests.synthetic import CALIBRATION, FLIGHT, SPIN, Motion, Shaking, messages
from velod.config import from_tree
from velod.geometry.so3 import exp
from velod.optimizer.bins import BIN_NS, Bins
from velod.optimizer.rotation_check import FAR_NS, NEAR_NS, RotationCheck
from velod.optimizer.stage import OptimizerStage
from velod.types import ImuSamples, Velocity

LOOKING = Shaking(
    np.array([2.0, -4.0, 3.0]), np.array([1.5, 0.5, 0.3]), np.array([1.5, 1.2, 0.8]), np.array([6.0, 5.0, 7.0])
)
"""In the hand: to and fro about all axes, up to 5.4 rad/s and 50 rad/s^2, beside a swinging translation."""
SECONDS = 2.4


def _turned(t):
    return exp(np.array([np.sin(7 * t), 0.8 * np.sin(5 * t + 1), 1.2 * np.sin(6 * t + 2)]))


def _rate(t, h=1e-5):
    R = _turned(t - h).T @ _turned(t + h)
    return np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * h)


class Wobbling(Motion):
    """Turns about changing axes, up to 10 rad/s."""

    def R_WB(self, t):
        return exp(np.array([1.8, 0.3, -0.2])) @ _turned(t)

    def omega_B(self, t):
        return _rate(t)


WOBBLING = Wobbling(LOOKING.w_B, LOOKING.v0_W, LOOKING.amplitude, LOOKING.rate)


def late(stream, by_s):
    """All events are stamped ``by_s`` too late; as nobody knows, the IMU's samples look early."""
    for m in stream:
        yield replace(m, sample_t_ns=m.sample_t_ns - int(by_s * 1e9)) if isinstance(m, ImuSamples) else m


def run(motion, by_s=0.0, calibration=CALIBRATION, seconds=SECONDS, seed=0, noise=1.0, **optimizer):
    """Errors from 0.8 s before the end on, m/s, and the stage."""
    stage = OptimizerStage(from_tree({"optimizer": optimizer}), calibration)
    out = [v for m in late(messages(motion, seconds, seed=seed, noise=noise), by_s) for v in stage.handle(m)]
    last = [v for v in out if isinstance(v, Velocity) and v.valid and v.t_ns > (seconds - 0.8) * 1e9]
    return np.array([np.linalg.norm(v.v_B - motion.v_B(v.t_ns * 1e-9 + by_s)) for v in last]), stage


def imu_alarms(stage):
    return [name for name in stage.alarms if name.startswith("calibration.imu")]


@pytest.mark.parametrize("by_s", [0.003, -0.003])
def test_a_clock_3_ms_wrong_is_found_within_half_a_millisecond_and_mended(by_s):
    """Within 2.4 s of lively motion: alarm, corrected stamps, and an error near that of right clocks."""
    right, _ = run(LOOKING)
    corrected, stage = run(LOOKING, by_s)
    unsuspecting, _ = run(LOOKING, by_s, correct_imu_clock=False, delay_sigma_ms=0.01)
    assert abs(stage.gauges["calibration.imu_clock_ms"] - 1e3 * by_s) < 0.5
    assert stage.gauges["calibration.imu_clock_sigma_ms"] < 0.5
    assert abs(stage._estimator.rotation_check.late_ns * 1e-6 - 1e3 * by_s) < 0.5
    assert "late against the IMU" in stage.alarms["calibration.imu_clock"]
    assert stage.counters["clock.corrected"] >= 1
    assert corrected.mean() < 1.3 * right.mean() + 0.002
    assert unsuspecting.mean() > 1.5 * corrected.mean()


@pytest.mark.parametrize("motion", [FLIGHT, SPIN, WOBBLING])
def test_right_clocks_and_mounts_are_left_alone(motion):
    _, stage = run(motion, seconds=1.6)
    assert "clock.corrected" not in stage.counters
    assert not imu_alarms(stage)
    clock, sigma = (stage.gauges[f"calibration.imu_clock{s}_ms"] for s in ("", "_sigma"))
    assert abs(clock) < 3.5 * sigma


@pytest.mark.parametrize("axis", range(3))
def test_cameras_turned_by_3_degrees_are_an_alarm(axis):
    """Of a rig that turns about all axes, with flows of 2 % as on recordings: noticed, about the right axis."""
    T = np.eye(4)
    T[:3, :3] = exp(np.radians(3.0) * np.eye(3)[axis])
    _, stage = run(WOBBLING, calibration=replace(CALIBRATION, T_cam_imu=T), noise=0.6)
    offsets = stage._estimator.rotation_check.offsets
    # calibration: R_CB = exp(3 degrees), truth: 1
    assert abs(np.degrees(offsets.rotation_B[axis]) + 3.0) < 1.0
    assert "of the IMU: T_cam_imu?" in stage.alarms["calibration.imu_rotation"]
    # a clock that only seems wrong because of it is left alone
    assert "clock.corrected" not in stage.counters


def test_of_a_motion_without_rotation_nothing_is_said():
    """Nothing is alarmed or corrected, however late the events are; of the axes nothing is known."""
    straight = replace(FLIGHT, w_B=np.zeros(3))
    _, stage = run(straight, 0.003, seconds=1.6)
    assert stage.gauges["calibration.imu_rotation_sigma_deg"] > 5.0
    assert not imu_alarms(stage) and "clock.corrected" not in stage.counters


class _Turning:
    """The memory of a gyroscope on a rig that turns by R(t)."""

    t_ns = np.array([0])

    def at(self, t_ns):
        R = np.array([_turned(t * 1e-9) for t in t_ns])
        return R, np.zeros((len(R), 3)), np.zeros((len(R), 3))


def test_delay_and_rotation_of_exact_batches_are_found_whatever_their_bias_and_scale():
    """b_app made of the exact angular velocity of a camera that is late, turned and too fast."""
    delay, theta, share, b_w = 0.004, np.radians([1.0, -2.0, 1.5]), 0.003, np.array([0.01, -0.02, 0.005])
    check, rng = RotationCheck(0.02, 1.86e-3, correct=False), np.random.default_rng(3)
    e = np.array([1.0, -0.5, 2.0])
    for k in range(4, 300):
        t = k * 0.0133
        b_app = b_w + _rate(t) - (1 + share) * exp(theta) @ _rate(t - delay) + 2 * share * _rate(t)
        bins, first = Bins(int(t * 1e9) // BIN_NS, 1), int(t * 1e9) // BIN_NS * BIN_NS
        root = rng.normal(size=(9, 9)) * 200.0
        bins.L[0] = root @ root.T
        bins.eta[0] = bins.L[0] @ np.concatenate([e, b_app, np.zeros(3)])
        bins.total[0] = 1.0, int(t * 1e9) - first
        check.add(bins, np.zeros(3), int(t * 1e9), e, np.eye(3) * 1e-4)
        check.advance(_Turning(), int(t * 1e9))
    found = check.offsets
    assert abs(found.delay_s - delay) < 0.1 * delay
    assert np.degrees(np.abs(found.rotation_B - theta)).max() < 0.15
    assert 0 < NEAR_NS < FAR_NS
