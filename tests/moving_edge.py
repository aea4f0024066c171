"""Stereo surfaces of one straight edge that crosses both images at one disparity, on any rig."""

from dataclasses import dataclass, replace

import numpy as np

from velod.geometry.calibration import Calibration, Camera
from velod.geometry.rectify import Rectification, rectify
from velod.types import StereoBatch

UNIT_NS = 1526
T_NS = 2_000_000_000
PLAIN = Camera(240, 180, 200.0, 200.0, 119.5, 89.5)
PLAIN_RIG = Calibration(PLAIN, PLAIN, np.eye(3), np.array([-0.1, 0.0, 0.0]))


@dataclass(frozen=True)
class Edge:
    """At the batch's end it lies at rectified x = ``x_px`` in row 90; its normal leans by ``angle``, rad, from x."""

    x_px: float = 150.0
    angle: float = 0.2
    speed_px_s: float = 300.0
    disparity_px: float = 7.37

    def age_s(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """How long ago it passed rectified (x, y) of the left image; negative: it has not."""
        return ((self.x_px - x) * np.cos(self.angle) + (90.0 - y) * np.sin(self.angle)) / self.speed_px_s


def surface(edges: list[Edge], xy: np.ndarray, *, right: bool, jitter_s: float, seed: int) -> np.ndarray:
    """Ages (h, w) uint16 on a sensor grid whose pixels lie at rectified ``xy``: the newest edge at each pixel."""
    rng = np.random.default_rng(seed)
    newest = np.full(xy.shape[:2], np.inf)
    for edge in edges:
        age = edge.age_s(xy[..., 0].astype(np.float64) + right * edge.disparity_px, xy[..., 1].astype(np.float64))
        age += jitter_s * rng.normal(size=age.shape)
        newest = np.where((age > 0.0) & (age < 0.1) & (age < newest), age, newest)
    units = np.ceil(np.where(np.isfinite(newest), newest, 0.0) * 1e9 / UNIT_NS)
    return np.clip(units, 0, 65535).astype(np.uint16)


def batch(
    *edges: Edge, calibration: Calibration = PLAIN_RIG, points: int = 200, jitter_s: float = 0.0, seed: int = 0
) -> StereoBatch:
    """ON events of the edges in both cameras, and ``points`` of the left ones behind the front, well inside."""
    rect = rectify(calibration)
    left = surface(list(edges), rect.left_xy, right=False, jitter_s=jitter_s, seed=seed)
    right = surface(list(edges), rect.right_xy, right=True, jitter_s=jitter_s, seed=seed + 1)
    rng = np.random.default_rng(seed)
    y, x = np.nonzero(usable(rect, left))
    chosen = rng.choice(len(x), min(points, len(x)), replace=False)
    y, x = y[chosen], x[chosen]
    return stereo_batch(left, right, x, y)


def stereo_batch(left: np.ndarray, right: np.ndarray, x: np.ndarray, y: np.ndarray) -> StereoBatch:
    """The ON events at (x, y) of the left surface, with both surfaces (h, w) uint16."""
    return StereoBatch(
        seq=3,
        t_ns=T_NS,
        t_start_ns=T_NS - 15_000_000,
        unit_ns=UNIT_NS,
        x=x.astype(np.uint16),
        y=y.astype(np.uint16),
        age=left[y, x].astype(np.uint32) * np.uint32(UNIT_NS),
        p=np.ones(len(x), np.uint8),
        left=np.stack([np.zeros_like(left), left]),
        right=np.stack([np.zeros_like(right), right]),
        left_last=left,
        right_last=right,
    )


def usable(rect: Rectification, left: np.ndarray) -> np.ndarray:
    """Pixels 3 to 9 px behind a front that lie at least 20 px inside the rectified grid."""
    age_px = left * (UNIT_NS * 1e-9) * 300.0
    x, y = rect.left_xy[..., 0], rect.left_xy[..., 1]
    inside = (x > 60) & (x < rect.width - 21) & (y > 20) & (y < rect.height - 21)
    margin = np.zeros_like(inside)
    margin[5:-5, 5:-5] = True
    return (age_px > 3.0) & (age_px < 9.0) & inside & margin


def without_right(message: StereoBatch) -> StereoBatch:
    return replace(message, right=np.zeros_like(message.right), right_last=np.zeros_like(message.right_last))
