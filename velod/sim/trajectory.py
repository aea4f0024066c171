"""Analytic motion: sums of sines for position and attitude, with exact derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from velod.types import F64

# Columns: the axes of B (x right, y down, z forward) in a frame F that looks forward, left, up.
_R_FB = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


Wave = tuple[float, float, float]
"""a, w (rad/s), phase (rad) of a sin(w t + phase)."""


@dataclass(frozen=True, slots=True)
class Harmonics:
    """x(t) = offset + rate t + sum of a sin(w t + phase) over ``waves`` of (a, w in rad/s, phase in rad)."""

    offset: float = 0.0
    rate: float = 0.0
    waves: tuple[Wave, ...] = ()

    def at(self, t_s: F64) -> tuple[F64, F64, F64]:
        """x, dx/dt and d2x/dt2 at ``t_s`` (n,)."""
        x = self.offset + self.rate * t_s
        dx, ddx = np.full_like(t_s, self.rate), np.zeros_like(t_s)
        for a, w, phase in self.waves:
            s, c = np.sin(w * t_s + phase), np.cos(w * t_s + phase)
            x, dx, ddx = x + a * s, dx + a * w * c, ddx - a * w * w * s
        return x, dx, ddx


@dataclass(frozen=True, slots=True)
class Motion:
    """The state of B at n moments."""

    p_WB: F64  # (n, 3) m
    v_W: F64  # (n, 3) m/s
    a_W: F64  # (n, 3) m/s^2
    R_WB: F64  # (n, 3, 3)
    omega_B: F64  # (n, 3) rad/s

    @property
    def v_B(self) -> F64:
        """(n, 3) m/s, frame B."""
        v_B: F64 = np.einsum("nji,nj->ni", self.R_WB, self.v_W)
        return v_B


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Position in cylindrical (radius, angle, height) or Cartesian coordinates; attitude by yaw, pitch, roll.

    ``cylindrical``: ``position`` is radius (m), angle (rad) and height (m), and yaw counts from the tangent.
    R_WB = Rz(yaw) Ry(pitch) Rx(roll) R_FB, with F forward, left, up.
    """

    position: tuple[Harmonics, Harmonics, Harmonics]
    yaw: Harmonics
    pitch: Harmonics
    roll: Harmonics
    cylindrical: bool = False

    def at(self, t_s: F64) -> Motion:
        """The state at ``t_s`` (n,)."""
        (x, dx, ddx), (y, dy, ddy), (z, dz, ddz) = (part.at(t_s) for part in self.position)
        yaw, dyaw, _ = self.yaw.at(t_s)
        if self.cylindrical:
            yaw, dyaw = yaw + y + np.pi / 2, dyaw + dy
            out = np.stack([np.cos(y), np.sin(y)])
            along = np.stack([-out[1], out[0]])
            p, v, a = x * out, dx * out + x * dy * along, (ddx - x * dy**2) * out + (x * ddy + 2 * dx * dy) * along
        else:
            p, v, a = np.stack([x, y]), np.stack([dx, dy]), np.stack([ddx, ddy])
        R_WB, omega_B = _attitude((yaw, dyaw), self.pitch.at(t_s)[:2], self.roll.at(t_s)[:2])
        return Motion(
            np.stack([*p, z], axis=1), np.stack([*v, dz], axis=1), np.stack([*a, ddz], axis=1), R_WB, omega_B
        )


@dataclass(frozen=True, slots=True)
class Shaken(Trajectory):
    """A trajectory that vibrates besides: a sine of the velocity, in all axes of W alike."""

    amplitude_mps: float = 0.0
    hz: float = 8.0

    def at(self, t_s: F64) -> Motion:
        """The state at ``t_s`` (n,)."""
        calm, w = Trajectory.at(self, t_s), 2.0 * np.pi * self.hz
        sine, cosine = (f(w * t_s)[:, None] * self.amplitude_mps / np.sqrt(3.0) for f in (np.sin, np.cos))
        return Motion(calm.p_WB - cosine / w, calm.v_W + sine, calm.a_W + cosine * w, calm.R_WB, calm.omega_B)


def shaken(trajectory: Trajectory, amplitude_mps: float, hz: float) -> Shaken:
    """``trajectory`` with a vibration of ``amplitude_mps``."""
    t = trajectory
    return Shaken(t.position, t.yaw, t.pitch, t.roll, t.cylindrical, amplitude_mps, hz)


def _attitude(yaw: tuple[F64, F64], pitch: tuple[F64, F64], roll: tuple[F64, F64]) -> tuple[F64, F64]:
    """R_WB (n, 3, 3) and omega_B (n, 3) from the angles and their rates."""
    (cy, cp, cr), (sy, sp, sr) = (tuple(f(angle[0]) for angle in (yaw, pitch, roll)) for f in (np.cos, np.sin))
    R_WF = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    ).transpose(2, 0, 1)
    dyaw, dpitch, droll = yaw[1], pitch[1], roll[1]
    omega_F = np.stack([droll - dyaw * sp, dpitch * cr + dyaw * cp * sr, -dpitch * sr + dyaw * cp * cr], axis=1)
    return R_WF @ _R_FB, omega_F @ _R_FB
