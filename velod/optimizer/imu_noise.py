"""How noisy the IMU is, by its own samples: data sheets are of another temperature, mounting or rate.

Motion is slow, or a vibration of few frequencies; white noise is the same at all of them. So the density is a low
quantile of the spectrum over a band that motion hardly reaches, over short spans one after another: neither lines in
it nor a blow move that much.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from velod.config import ImuSettings
from velod.events.sae import NEVER
from velod.optimizer.inertial import InertialMemory
from velod.types import F64, NS_PER_S

BAND_HZ = (40.0, 100.0)
"""Above what hands and vehicles do, below where IMUs filter; from a quarter to half of the rate of a slower IMU."""
HOP_NS, SPAN_NS, HELD = NS_PER_S // 10, NS_PER_S // 5, 10
"""Every HOP_NS the spectrum of the last SPAN_NS; so many of them count."""
LEAST_SAMPLES = 16
"""Of a span: below, the band has hardly a line."""
UNEVEN = 1.5
"""Longest over median time between samples, beyond which their spectrum says nothing."""
SURE = 3.0
"""Sigmas by which the density must exceed the specified one to count."""
QUANTILE = 0.3
"""Of the powers: two thirds of them may be something else."""
OF_MEAN = -math.log(1.0 - QUANTILE)
"""That quantile of noise over its mean: powers are distributed exponentially ..."""
QUANTILE_SIGMA = math.sqrt(QUANTILE / (1.0 - QUANTILE)) / OF_MEAN
"""... and the standard deviation of that of n powers, as a share, times the root of n."""
CHANGED = 1.1
"""A density that differs less from the one in use is the same."""


class ImuNoise:
    """``settings``: those of the IMU, with the noise densities that it shows where they exceed the specified ones."""

    def __init__(self, specified: ImuSettings) -> None:
        self.settings = self._specified = specified
        self._next_ns = NEVER
        self._held: deque[tuple[F64, F64]] = deque(maxlen=HELD)

    def look(self, memory: InertialMemory, t_ns: int) -> bool:
        """Look at the samples up to ``t_ns``; whether the settings have changed."""
        if t_ns < self._next_ns or t_ns - memory.t_ns[0] < HOP_NS:
            return False
        self._next_ns = t_ns + HOP_NS
        span = memory.between(t_ns - SPAN_NS, t_ns)
        t = memory.t_ns[span]
        if len(t) < LEAST_SAMPLES or np.diff(t).max() > UNEVEN * np.median(np.diff(t)):
            return False
        rate_hz = (len(t) - 1) * NS_PER_S / int(t[-1] - t[0])
        self._held.append((density(memory.accel[span], rate_hz), density(memory.gyro[span], rate_hz)))
        return self._conclude()

    @property
    def excess(self) -> tuple[float, float]:
        """Accelerometer's and gyroscope's density over the specified one, at least 1."""
        used, told = self.settings, self._specified
        return used.accel_noise / told.accel_noise, used.gyro_noise / told.gyro_noise

    def _conclude(self) -> bool:
        told, used = self._specified, self.settings
        accel = _at_least(told.accel_noise, [a for a, _ in self._held])
        gyro = _at_least(told.gyro_noise, [g for _, g in self._held])
        changes = max(
            accel / used.accel_noise, used.accel_noise / accel, gyro / used.gyro_noise, used.gyro_noise / gyro
        )
        if changes < CHANGED:
            return False
        self.settings = replace(told, accel_noise=accel, gyro_noise=gyro)
        return True


def density(samples: F64, rate_hz: float) -> F64:
    """Powers per Hz (two-sided) of every line of the band and axis of ``samples`` (n, 3): noise has density^2."""
    window = np.hanning(len(samples))
    spectrum = np.fft.rfft((samples - samples.mean(axis=0)) * window[:, None], axis=0)
    f_hz = np.fft.rfftfreq(len(samples), 1.0 / rate_hz)
    low, high = min(BAND_HZ[0], rate_hz / 4.0), min(BAND_HZ[1], rate_hz / 2.0)
    inside = spectrum[(f_hz >= low) & (f_hz < high)]
    power: F64 = np.abs(inside) ** 2 / (rate_hz * float(window @ window))
    return power.ravel()


def _at_least(specified: float, powers: list[F64]) -> float:
    """The density that the powers show, where it is certain to exceed the specified one."""
    all_of_them = np.concatenate(powers)
    found = float(np.quantile(all_of_them, QUANTILE)) / OF_MEAN
    certain = found / (1.0 + SURE * QUANTILE_SIGMA / math.sqrt(len(all_of_them)))
    return math.sqrt(found) if certain > specified**2 else specified
