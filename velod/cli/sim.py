"""``velod sim``: what of a sequence's recipe the command line can change."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from velod.cli.values import seed

if TYPE_CHECKING:
    from velod.sim import Sequence

# Option, field of velod.sim.effects.Effects, type, unit, help.
_EFFECTS: tuple[tuple[str, str, Callable[[str], object], str, str], ...] = (
    ("--noise", "noise_hz", float, "HZ", "background events of each pixel (real: 0.1 to 5)"),
    ("--hot-pixels", "hot_share", float, "SHARE", "of the pixels that fire at 500 Hz on their own (real: 1e-4)"),
    ("--leak", "leak_hz", float, "HZ", "ON events of each pixel where nothing changes (real: 0.1)"),
    ("--bandwidth", "bandwidth_hz", float, "HZ", "low-pass of each pixel at full intensity, less in the dark"),
    ("--jitter", "jitter_us", float, "US", "standard deviation of a time stamp"),
    ("--quantum", "quantum_us", int, "US", "time stamps are multiples of it (200 with some drivers)"),
    ("--bus", "bus_mev_s", float, "MEV/S", "events that a camera can read out; more wait up to 1 ms, then are lost"),
    ("--clock-offset", "clock_offset_us", int, "US", "the right camera's stamps are so much later"),
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Sensor, rays, texture, IMU rate, contrast threshold and real-sensor effects."""
    parser.add_argument(
        "--imu-hz", type=int, metavar="HZ", help="rate of the IMU, a divisor of 1,000,000 (default 200)"
    )
    parser.add_argument(
        "--sensor", type=_size, default=(346, 260), metavar="WxH",
        help="columns and rows of both cameras, such as 640x480 (default 346x260)",
    )  # fmt: skip
    parser.add_argument(
        "--rays", type=int, default=1, metavar="K",
        help="a pixel's light is the mean over K x K rays, not one at its centre (1 to 4, default 1): outlines then "
        "cross it gradually, as on a real sensor; K = 2 takes two to five times as long",
    )  # fmt: skip
    parser.add_argument("--texture", type=seed, metavar="SEED", help="other leaves on walls and boxes")
    parser.add_argument("--threshold", type=float, metavar="C", help="contrast at which pixels fire (default 0.5)")
    parser.add_argument(
        "--vibration",
        type=_vibration,
        metavar="M/S,HZ",
        help="of the whole rig, such as 1,8 (amplitude of the velocity)",
    )
    group = parser.add_argument_group("real-sensor effects", "All off unless given.")
    group.add_argument(
        "--threshold-spread", type=float, metavar="C", help="mismatch of the thresholds (sigma; default 0.021)"
    )
    for option, field, kind, unit, text in _EFFECTS:
        group.add_argument(option, dest=field, type=kind, default=kind("0"), metavar=unit, help=text)
    group.add_argument(
        "--distortion", type=_coefficients, default=(), metavar="K1,K2,P1,P2,K3", help="radtan, of both lenses"
    )


def recipe_of(args: argparse.Namespace) -> Sequence:
    """The sequence that the arguments ask for. Raises SequenceError, SensorError."""
    from velod.sim import sequence
    from velod.sim.effects import Effects
    from velod.sim.trajectory import shaken

    recipe = sequence(args.sequence, args.texture)
    effects = Effects(radtan=args.distortion, **{field: getattr(args, field) for _, field, *_ in _EFFECTS})
    events, imu, trajectory = recipe.events, recipe.imu, recipe.trajectory
    if args.vibration is not None:
        trajectory = shaken(trajectory, *args.vibration)
    if args.threshold is not None:
        events = replace(events, threshold=args.threshold)
    if args.threshold_spread is not None:
        events = replace(events, threshold_sigma=args.threshold_spread)
    if args.imu_hz is not None:
        imu = replace(imu, rate_hz=args.imu_hz)
    return replace(
        recipe,
        trajectory=trajectory,
        effects=effects,
        events=events,
        imu=imu,
        sensor=args.sensor,
        rays_per_side=args.rays,
    )


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{2,4})x(\d{2,4})", text)
    if match is None or not all(32 <= int(side) <= 4096 for side in match.groups()):
        raise argparse.ArgumentTypeError(f"must be WIDTHxHEIGHT, each from 32 to 4096, got {text!r}")
    return int(match[1]), int(match[2])


def _vibration(text: str) -> tuple[float, float]:
    amplitude_mps, _, hz = text.partition(",")
    try:
        values = float(amplitude_mps), float(hz)
    except ValueError:
        values = (0.0, 0.0)
    if not all(0.0 < v < 1000.0 for v in values):
        raise argparse.ArgumentTypeError(f"must be two positive numbers, M/S,HZ, got {text!r}")
    return values


def _coefficients(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"not numbers: {text!r}") from None
    if len(values) != 5:
        raise argparse.ArgumentTypeError(f"must be five numbers, got {len(values)}")
    return values
