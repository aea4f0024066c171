"""Flow, depth and IMU messages made from an analytic motion: what a perfect front end would say, with noise."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from velod.geometry.calibration import Calibration, Camera
from velod.geometry.camera import A_v, B_w
from velod.geometry.so3 import exp
from velod.types import DepthBatch, FlowBatch, ImuSamples

CAMERA = Camera(346, 260, 231.5, 231.5, 172.3, 130.8)
BASELINE_M = 0.12
CALIBRATION = Calibration(CAMERA, CAMERA, np.eye(3), np.array([-BASELINE_M, 0.0, 0.0]))
G_W = np.array([0.0, 0.0, 9.81])


@dataclass(frozen=True, eq=False)
class Motion:
    """Rotation at a constant rate from a tilted start, and v_W(t) = v0 + amplitude sin(rate t)."""

    w_B: np.ndarray
    v0_W: np.ndarray
    amplitude: np.ndarray
    rate: np.ndarray

    def R_WB(self, t):
        return exp(np.array([1.8, 0.3, -0.2])) @ exp(self.w_B * t)

    def omega_B(self, t):
        return self.w_B

    def v_B(self, t):
        return self.R_WB(t).T @ (self.v0_W + self.amplitude * np.sin(self.rate * t))

    def accel(self, t):
        """Specific force, frame B, gravity upwards (Eq. 8)."""
        return self.R_WB(t).T @ (self.amplitude * self.rate * np.cos(self.rate * t) + G_W)


FLIGHT = Motion(
    np.array([0.4, -0.9, 0.6]), np.array([2.0, 1.0, 0.3]), np.array([0.8, 1.2, 0.5]), np.array([3.0, 2.0, 5.0])
)
SPIN = Motion(
    np.array([2.0, -12.0, 5.0]), np.array([1.0, 2.0, 0.0]), np.array([3.0, 3.0, 1.0]), np.array([6.0, 5.0, 7.0])
)


class Shaking(Motion):
    """Looks to and fro about the axis ``w_B``, up to its rate, at 1.5 Hz."""

    def R_WB(self, t):
        return exp(np.array([1.8, 0.3, -0.2])) @ exp(self.w_B * np.sin(3.0 * np.pi * t) / (3.0 * np.pi))

    def omega_B(self, t):
        return self.w_B * np.cos(3.0 * np.pi * t)


class Braking(Motion):
    """Comes to rest smoothly within ``BRAKED_S``, without turning."""

    BRAKED_S = 0.8

    def v_B(self, t):
        return self.R_WB(t).T @ self.v0_W * max(0.0, 1 - t / self.BRAKED_S) ** 2

    def accel(self, t):
        slowing = -2 * max(0.0, 1 - t / self.BRAKED_S) / self.BRAKED_S
        return self.R_WB(t).T @ (self.v0_W * slowing + G_W)


REST = Motion(np.zeros(3), np.zeros(3), np.zeros(3), np.ones(3))


@cache
def messages(
    motion,
    seconds,
    seed=0,
    flows=250,
    period_s=0.015,
    imu_hz=200,
    noise=1.0,
    outliers=0.03,
    dark=(9.0, 9.0),
    upright_s=(99.0, 99.0),
):
    """ImuSamples, FlowBatch and DepthBatch in the order in which they would arrive.

    No flows within ``dark`` s; none but of edges along the image's columns within ``upright_s``.
    """
    rng = np.random.default_rng(seed)
    imu_t = np.arange(int((seconds + 0.1) * imu_hz) + 1) / imu_hz
    accel = (
        np.array([motion.accel(t) for t in imu_t])
        + rng.normal(size=(len(imu_t), 3)) * 1.86e-2 * np.sqrt(imu_hz) * noise
    )
    gyro = (
        np.array([motion.omega_B(t) for t in imu_t])
        + rng.normal(size=(len(imu_t), 3)) * 1.86e-3 * np.sqrt(imu_hz) * noise
    )
    imu_ns = np.round(imu_t * 1e9).astype(np.int64)
    nothing = ImuSamples(0, 0, 0, -1, 0, imu_ns[:0], accel[:0], gyro[:0])
    out, sent = [nothing], 0
    for seq in range(int(seconds / period_s)):
        end_ns = int((seq + 1) * period_s * 1e9)
        upto = int(np.searchsorted(imu_ns, end_ns, side="right")) + 1
        part = slice(sent, upto)
        out.append(
            ImuSamples(seq + 1, int(imu_ns[upto - 1]), end_ns, seq, end_ns, imu_ns[part], accel[part], gyro[part])
        )
        sent = upto
        m = 0 if dark[0] < end_ns * 1e-9 <= dark[1] else flows
        upright = upright_s[0] < end_ns * 1e-9 <= upright_s[1]
        out += _front_end(motion, rng, seq, end_ns, int(period_s * 1e9), m, noise, outliers, upright)
    return tuple(out)


def _front_end(motion, rng, seq, end_ns, period_ns, m, noise, outliers, upright):
    age = rng.integers(1, period_ns, m)
    v = np.array([motion.v_B((end_ns - a) * 1e-9) for a in age]).reshape(-1, 3)
    omega = np.array([motion.omega_B((end_ns - a) * 1e-9) for a in age]).reshape(-1, 3)
    x, y, Z = rng.uniform(10, 336, m), rng.uniform(10, 250, m), rng.uniform(1.5, 6.0, m)
    u, w, f = x - CAMERA.cx, y - CAMERA.cy, CAMERA.fx
    flow = np.einsum("mij,mj->mi", A_v(u, w, f), v) / Z[:, None] + np.einsum("mij,mj->mi", B_w(u, w, f), omega)
    angle = np.zeros(m) if upright else rng.uniform(0, 2 * np.pi, m)
    n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    n *= np.sign(np.sum(flow * n, axis=1))[:, None]
    true_speed = np.sum(flow * n, axis=1)
    sigma = 1.0 + 0.03 * true_speed
    speed = np.maximum(true_speed + rng.normal(size=m) * sigma * noise, 1e-3)
    bad = rng.random(m) < outliers
    speed[bad] *= rng.uniform(0.3, 2.0, int(bad.sum()))
    if upright:
        # the plane's slope errs across the edge's normal as much as along it
        error = rng.normal(size=m) * sigma / np.maximum(true_speed, 10.0) * noise
        n = np.stack([n[:, 0] * np.cos(error), n[:, 0] * np.sin(error)], axis=1)
    fb = f * BASELINE_M
    sigma_inv = np.full(m, 0.06 / fb)
    inv_depth = 1 / Z + rng.normal(size=m) * sigma_inv * noise
    index = np.arange(m, dtype=np.uint16)
    f4 = np.float32
    return [
        FlowBatch(
            seq,
            end_ns,
            m,
            index,
            age.astype(np.uint32),
            x.astype(f4),
            y.astype(f4),
            n.astype(f4),
            speed.astype(f4),
            sigma.astype(f4),
            n_events=90 * m,
        ),
        DepthBatch(
            seq,
            end_ns,
            m,
            index,
            (inv_depth * fb).astype(f4),
            inv_depth.astype(f4),
            sigma_inv.astype(f4),
            np.ones(m, np.uint8),
        ),
    ]


def errors(velocities, motion):
    """|v - truth| of the valid velocities, m/s."""
    return np.array([np.linalg.norm(v.v_B - motion.v_B(v.t_ns * 1e-9)) for v in velocities if v.valid])


def renumber(stream, by):
    """The messages as another ingest would number them: every seq + ``by``."""
    for m in stream:
        batch = {"batch_seq": m.batch_seq + by} if isinstance(m, ImuSamples) else {}
        yield replace(m, seq=m.seq + by, **batch)


def silent(stream, from_s, to_s=float("inf")):
    """The stream as ingest sends it where there is no left event for long: no batches at all, time alone goes on."""
    gone, last = set(), None
    for m in stream:
        inside = from_s * 1e9 < m.t_ns <= to_s * 1e9
        if isinstance(m, ImuSamples):
            if m.batch_seq >= 0 and from_s * 1e9 < m.batch_t_ns <= to_s * 1e9:
                gone.add(m.batch_seq)
                m = replace(m, batch_seq=last[0], batch_t_ns=last[1])
            elif m.batch_seq >= 0:
                m = replace(m, batch_seq=m.batch_seq - len(gone))
                last = (m.batch_seq, m.batch_t_ns)
            yield m
        elif not inside:
            yield replace(m, seq=m.seq - len(gone))


def with_imu(stream, change):
    """The stream with ``change(t_s, accel, gyro) -> (accel, gyro)`` applied to its samples, (n,), (n, 3), (n, 3)."""
    for m in stream:
        if isinstance(m, ImuSamples) and len(m.sample_t_ns):
            accel, gyro = change(m.sample_t_ns * 1e-9, m.accel.copy(), m.gyro.copy())
            m = replace(m, accel=accel, gyro=gyro)
        yield m
