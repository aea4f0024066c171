"""The rows of a batch, made in one pass, against plain algebra and central differences."""

from dataclasses import replace

import numpy as np
import pytest

from tests.synthetic import FLIGHT, SPIN, messages
from velod.geometry.so3 import exp
from velod.optimizer.equations import ACCELERATION_NS, EquationMaker, Prediction
from velod.optimizer.flow_equation import COMMON, body_rows, pairs
from velod.optimizer.inertial import InertialMemory
from velod.types import DepthBatch, FlowBatch, ImuSamples

CAMERA = (231.5, 172.3, 130.8)
R_CB, P_BC_B = exp(np.array([0.3, -0.2, 0.5])), np.array([0.1, -0.05, 0.2])


def batch(motion, seq=12):
    """Memory of the IMU up to a batch, its flow, and depths of two thirds of its events."""
    stream = messages(motion, 0.3)
    memory = InertialMemory(2.0)
    for m in stream:
        if isinstance(m, ImuSamples):
            memory.append(m.sample_t_ns, m.accel, m.gyro)
    memory.integrate_to(int(memory.t_ns[-1]), np.zeros(3), np.zeros(3))
    flow, depth = (
        next(m for m in stream if isinstance(m, kind) and m.seq == seq) for kind in (FlowBatch, DepthBatch)
    )
    kept = np.flatnonzero(np.arange(len(depth.index)) % 3)
    columns = {name: getattr(depth, name)[kept] for name in ("index", "disparity", "inv_depth", "sigma", "refined")}
    return memory, flow, replace(depth, **columns)


def known_of(memory, t_ns):
    return Prediction(
        t_ns, np.array([3.0, -1.0, 0.5]) - memory.at(np.array([t_ns]))[1][0], np.array([1.0, -9.0, 3.0])
    )


@pytest.mark.parametrize("motion", [FLIGHT, SPIN])
def test_all_rows_are_those_of_plain_algebra(motion):
    memory, flow, depth = batch(motion)
    earliest = flow.t_ns - 10_000_000
    eq = EquationMaker(CAMERA, R_CB, P_BC_B).make(flow, depth, memory, earliest, None)
    i, j = pairs(flow.index, depth.index)
    t = flow.t_ns - flow.age[i].astype(np.int64)
    i, j, t = i[t >= earliest], j[t >= earliest], t[t >= earliest]
    assert 0 < len(t) < len(depth.index) and np.array_equal(eq.on_error.t_ns, t)
    n, rho = flow.n[i].astype(float), depth.inv_depth[j]
    where = (rho, CAMERA, R_CB, P_BC_B)
    a, b = body_rows((flow.x[i], flow.y[i]), n, *where)
    turned, _ = body_rows((flow.x[i], flow.y[i]), np.stack([-n[:, 1], n[:, 0]], axis=1), *where)
    R, s, w = memory.at(t)
    z = flow.speed[i] - np.sum(b * w, axis=1)
    assert np.allclose(eq.on_velocity.a, a) and np.allclose(eq.on_velocity.b, b) and np.allclose(eq.on_velocity.z, z)
    assert np.allclose(eq.across, np.einsum("mij,mj->mi", R, turned), atol=1e-9)
    # v_B = R_BL (s_L + e) put into the rows on v_B says the same, whatever e
    e = np.array([0.3, -2.0, 1.0])
    v_B = np.einsum("mji,mj->mi", R, s + e)
    assert np.allclose(eq.on_error.z - eq.on_error.a @ e, z - np.sum(a * v_B, axis=1), atol=1e-8)
    assert np.allclose(eq.measured.translational, z) and np.allclose(eq.measured.speed, flow.speed[i])
    assert np.allclose(eq.measured.depth_share, depth.sigma[j] / rho)
    assert np.isclose(eq.depth_m, 1.0 / np.median(rho))
    assert not eq.common.any()


@pytest.mark.parametrize("motion", [FLIGHT, SPIN])
def test_the_rows_of_common_errors_are_central_differences(motion):
    """Speeds (1 + scale) [translation (1 + depth scale) + rotation] of a moment that is earlier by the delay.

    Velocity along gravity's slope, angular velocity and its change as before the batch: what the rows may know.
    """
    memory, flow, depth = batch(motion)
    known = known_of(memory, flow.t_ns - 20_000_000)
    eq = EquationMaker(CAMERA, R_CB, P_BC_B).make(flow, depth, memory, 0, known)
    t0 = int(eq.on_error.t_ns.min())
    R, s, _ = memory.at(t0 + np.array([-2, -1, 0]) * ACCELERATION_NS)

    def v_L(t_ns, s_L):
        return s_L + known.e_L - (t_ns - known.t_ns) * 1e-9 * known.g_L

    h = ACCELERATION_NS * 1e-9
    v_dot = (R[2].T @ v_L(t0, s[2]) - R[0].T @ v_L(t0 - 2 * ACCELERATION_NS, s[0])) / (2 * h)
    turns = [
        np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]]) / 2
        for M in (R[0].T @ R[1], R[1].T @ R[2])
    ]
    w, w_dot = (turns[0] + turns[1]) / (2 * h), (turns[1] - turns[0]) / h**2
    a, b = eq.on_velocity.a, eq.on_velocity.b
    R_t, s_t, _ = memory.at(eq.on_error.t_ns)
    v_t = np.array([R_k.T @ v_L(t, s_k) for R_k, s_k, t in zip(R_t, s_t, eq.on_error.t_ns, strict=True)])

    def flow_of(scale, delay, depth_scale):
        translational = np.sum(a * (v_t - delay * v_dot), axis=1)
        rotational = b @ (w - delay * w_dot)
        return (1 + scale) * (translational * (1 + depth_scale) + rotational)

    step = 1e-6
    for k in range(len(COMMON)):
        d = np.eye(3)[k] * step
        numeric = (flow_of(*d) - flow_of(*-d)) / (2 * step)
        assert np.allclose(eq.common[:, k], numeric, rtol=1e-6, atol=1e-3), COMMON[k]


def test_a_batch_larger_than_any_before_finds_room():
    memory, flow, depth = batch(FLIGHT)
    maker = EquationMaker(CAMERA, R_CB, P_BC_B)
    few = maker.make(flow, depth, memory, 0, None).on_error.a.copy()
    at = np.repeat(np.arange(len(flow.index)), 5)
    many = {name: getattr(flow, name)[at] for name in ("age", "x", "y", "n", "speed", "sigma")}
    wide = replace(flow, index=np.arange(len(at), dtype=np.uint16), **many)
    depths = {
        name: np.resize(getattr(depth, name), len(at)) for name in ("disparity", "inv_depth", "sigma", "refined")
    }
    eq = maker.make(wide, replace(depth, index=wide.index, **depths), memory, 0, None)
    assert len(eq.on_error.z) == 5 * len(flow.index) > 512
    assert np.array_equal(maker.make(flow, depth, memory, 0, None).on_error.a, few)


def test_the_lever_arm_is_a_central_difference():
    """v_C = R_CB (v_B + w x p): what a displacement of the camera does to the predicted flow."""
    memory, flow, depth = batch(FLIGHT)
    v, w, h = np.array([1.0, -2.0, 0.5]), np.array([0.7, 1.1, -0.4]), 1e-4

    def predicted(p):
        rows = EquationMaker(CAMERA, R_CB, p).make(flow, depth, memory, 0, None).on_velocity
        return rows.a @ v + rows.b @ w, rows.a.copy()

    _, a = predicted(P_BC_B)
    for k in range(3):
        d = np.eye(3)[k] * h
        numeric = (predicted(P_BC_B + d)[0] - predicted(P_BC_B - d)[0]) / (2 * h)
        assert np.allclose(numeric, a @ np.cross(w, np.eye(3)[k]), atol=1e-7)
