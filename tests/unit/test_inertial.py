"""The motion integrated from the IMU, R_LB and s_L, against the preintegration from the first sample (Eq. 9)."""

import numpy as np
import pytest

from velod.optimizer.inertial import InertialMemory
from velod.optimizer.preintegration import preintegrate

B_A, B_W = np.array([0.1, -0.2, 0.05]), np.array([0.01, 0.02, -0.03])


def tumbling(samples=60, step_ns=5_000_000):
    rng = np.random.default_rng(4)
    t = np.arange(samples) * step_ns
    w = 5 * np.sin(t[:, None] * 1e-9 * np.array([9.0, 7.0, 11.0])) + rng.normal(size=3)
    a = 15 * np.cos(t[:, None] * 1e-9 * np.array([5.0, 8.0, 6.0])) + rng.normal(size=3)
    return t, a, w


def filled():
    t, a, w = tumbling()
    memory = InertialMemory(1.0)
    memory.append(t, a, w)
    memory.integrate_to(int(t[-1]), B_A, B_W)
    return memory, t, a, w


@pytest.mark.parametrize("t_ns", [0, 5_000_000, 123_456_789, 294_999_999])
def test_the_nominal_motion_is_the_preintegration_from_the_first_sample(t_ns):
    memory, t, a, w = filled()
    R, s, _ = memory.at(np.array([t_ns]))
    p = preintegrate(t, a, w, 0, t_ns, B_A, B_W, 1.0, 1.0)
    # both by Simpson's rule, which is exact to the same order between samples
    assert np.allclose(R[0], p.R_gamma, atol=1e-6)
    assert np.allclose(s[0], p.beta, atol=1e-6)


def test_the_gyroscope_is_read_linearly_between_samples():
    memory, t, _, w = filled()
    at = np.array([2_500_000, 7_000_000, 291_000_000])
    twin = np.column_stack([np.interp(at, t, w[:, i]) for i in range(3)])
    assert np.allclose(memory.at(at)[2], twin, atol=1e-12)


def test_the_motion_at_many_moments_is_that_at_each():
    memory, t, _, _ = filled()
    at = np.random.default_rng(1).integers(0, t[-1], 50)
    together = memory.at(at)
    for k, t_ns in enumerate(at):
        for whole, single in zip(together, memory.at(np.array([t_ns])), strict=True):
            assert np.array_equal(whole[k], single[0])
