"""The IMU's own samples say how noisy it is, whatever the settings claim."""

import numpy as np
import pytest

from tests.synthetic import FLIGHT, errors, messages, with_imu
from tests.unit.test_scenarios import nees, run
from velod.config import ImuSettings
from velod.optimizer.imu_noise import SPAN_NS, ImuNoise
from velod.optimizer.inertial import InertialMemory
from velod.types import F64

SPECIFIED = ImuSettings()


def densities(
    rate_hz: int, accel: float, gyro: float, motion: F64 | None = None, seconds: float = 1.0
) -> ImuSettings:
    """What is found of an IMU with so many times the specified noise, ``motion`` (n, 3) in both its sensors."""
    rng = np.random.default_rng(3)
    t_ns = np.arange(round(seconds * rate_hz) + 1, dtype=np.int64) * (1_000_000_000 // rate_hz)
    white = rng.normal(size=(2, len(t_ns), 3)) * np.sqrt(rate_hz) + (0.0 if motion is None else motion)
    memory, noise = InertialMemory(3.0), ImuNoise(SPECIFIED)
    accel_B, gyro_B = white[0] * accel * SPECIFIED.accel_noise, white[1] * gyro * SPECIFIED.gyro_noise
    memory.append(t_ns, accel_B, gyro_B)
    for t in t_ns[:: rate_hz // 50]:
        noise.look(memory, int(t))
    return noise.settings


@pytest.mark.parametrize("rate_hz", [100, 200, 1000])
def test_noise_beyond_the_settings_is_found_within_a_fifth(rate_hz: int) -> None:
    found = densities(rate_hz, accel=10.0, gyro=3.0)
    assert found.accel_noise == pytest.approx(10.0 * SPECIFIED.accel_noise, rel=0.2)
    assert found.gyro_noise == pytest.approx(3.0 * SPECIFIED.gyro_noise, rel=0.2)


@pytest.mark.parametrize("times", [0.1, 1.0])
def test_an_imu_as_good_as_specified_or_better_keeps_the_settings(times: float) -> None:
    """What the settings hold beyond white noise (scale, vibration) is not for the spectrum to take away."""
    assert densities(200, times, times) == SPECIFIED


def test_a_vibration_and_a_blow_are_no_noise() -> None:
    """A line of 60 Hz, 50 sigmas high, and 20 ms of 300 sigmas."""
    t = np.arange(201) / 200.0
    line = 50.0 * np.sin(2.0 * np.pi * 60.0 * t) * np.sqrt(200.0)
    blow = np.where(np.abs(t - 0.5) < 0.01, 300.0, 0.0) * np.sqrt(200.0)
    for motion in (line, blow):
        found = densities(200, 1.0, 1.0, motion[:, None])
        assert found.accel_noise < 1.5 * SPECIFIED.accel_noise
        assert found.gyro_noise < 1.5 * SPECIFIED.gyro_noise


def test_samples_with_a_hole_say_nothing() -> None:
    t_ns = np.delete(np.arange(41, dtype=np.int64) * 5_000_000, slice(18, 22))
    memory, noise = InertialMemory(3.0), ImuNoise(SPECIFIED)
    loud = np.random.default_rng(1).normal(size=(2, len(t_ns), 3))
    memory.append(t_ns, *loud)
    assert not noise.look(memory, SPAN_NS)
    assert noise.settings == SPECIFIED


@pytest.mark.parametrize("times", [3.0, 10.0])
def test_an_imu_of_another_class_than_the_settings_gives_an_honest_covariance_and_an_alarm(times: float) -> None:
    """NEES 3 is right; without a look at the noise it is 8 to 30 (made scenes)."""
    rng = np.random.default_rng(7)
    extra = np.sqrt(times**2 - 1.0) * np.sqrt(200.0)

    def noisier(t: F64, a: F64, w: F64) -> tuple[F64, F64]:
        more = rng.normal(size=(2, len(t), 3)) * extra
        return a + more[0] * SPECIFIED.accel_noise, w + more[1] * SPECIFIED.gyro_noise

    velocities, stage = run(with_imu(messages(FLIGHT, 3.0), noisier))
    valid = [v for v in velocities if v.valid]
    assert len(valid) > 0.5 * len(velocities)
    assert nees(valid, FLIGHT).mean() < 5.0
    assert errors(valid, FLIGHT).mean() < 0.045 * times
    assert "times the noise" in stage.alarms["imu.noise"]
