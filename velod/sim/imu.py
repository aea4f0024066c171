"""An IMU: specific force and angular velocity of a motion, with white noise and drifting biases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from velod.io.model import Imu
from velod.sim.effects import SensorError
from velod.sim.trajectory import Trajectory
from velod.types import F64

GRAVITY_W = np.array([0.0, 0.0, 9.81])
"""g of Eq. 8 points up: an accelerometer at rest shows +9.81 upwards. m/s^2."""


@dataclass(frozen=True, slots=True)
class ImuModel:
    """Noise as continuous-time densities: a sample's sigma is density * sqrt(rate)."""

    rate_hz: int = 200  # a whole number of microseconds apart
    accel_noise: float = 1.86e-2  # m/s^2/sqrt(Hz)
    gyro_noise: float = 1.86e-3  # rad/s/sqrt(Hz)
    accel_bias_walk: float = 4.33e-3  # m/s^2/sqrt(s)
    gyro_bias_walk: float = 2.66e-4  # rad/s/sqrt(s)

    def __post_init__(self) -> None:
        """Raises SensorError."""
        if self.rate_hz <= 0 or 1_000_000 % self.rate_hz != 0:
            raise SensorError(f"the IMU's rate must divide 1,000,000 Hz, got {self.rate_hz}")

    def noiseless(self) -> ImuModel:
        """The same rate without noise and without walking biases."""
        return ImuModel(self.rate_hz, 0.0, 0.0, 0.0, 0.0)


def sample_imu(trajectory: Trajectory, model: ImuModel, seconds: float, rng: np.random.Generator) -> Imu:
    """Samples from t = 0 up to and including ``seconds``; the biases start at zero."""
    t_us = np.arange(0, round(seconds * 1e6) + 1, 1_000_000 // model.rate_hz, dtype=np.int64)
    motion = trajectory.at(t_us / 1e6)
    # Eq. 8: specific force R_BW (a_W + g_W)
    force_B = np.einsum("nji,nj->ni", motion.R_WB, motion.a_W + GRAVITY_W)
    accel = force_B + _errors(len(t_us), model.rate_hz, model.accel_noise, model.accel_bias_walk, rng)
    gyro = motion.omega_B + _errors(len(t_us), model.rate_hz, model.gyro_noise, model.gyro_bias_walk, rng)
    return Imu(t_us * 1000, accel, gyro)


def _errors(n: int, rate_hz: int, noise: float, walk: float, rng: np.random.Generator) -> F64:
    white = rng.normal(size=(n, 3)) * noise * np.sqrt(rate_hz)
    steps = rng.normal(size=(n, 3)) * walk / np.sqrt(rate_hz)
    steps[0] = 0.0
    total: F64 = white + np.cumsum(steps, axis=0)
    return total
