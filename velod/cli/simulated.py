"""``velod demo`` and ``sim``: simulated sensors, into a file or through the service."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from velod.cli.config import settings_of
from velod.cli.exit import RunFailed
from velod.cli.files import write_csv, write_json
from velod.cli.line import Bar
from velod.cli.play import PlayOptions, play
from velod.cli.played import metrics_of, result_row, shortcomings, summary

if TYPE_CHECKING:
    from velod.sim import Sequence

# What a demo must reach; corridors and boxes give 0.03 to 0.05 m/s, spins of 13 rad/s twice as much.
_DEMO_AVE_MPS = {"corridor": 0.1, "boxes": 0.1, "spin": 0.2}


def simulate_to_file(recipe: Sequence, path: str, seconds: float, seed: int) -> int:
    """Record a simulated sequence. Raises RecordingError."""
    from velod.sim import simulate

    with Bar(f"simulating {seconds:g} s of {recipe.name}") as bar:
        simulate(recipe, seconds, seed, path, bar.show)
    print(f"wrote {path}")
    return 0


def demo(config: str | None, name: str, seconds: float, seed: int, csv: str | None, json: str | None) -> int:
    """Simulated sensors through the service. Raises RunFailed where the result is not as it should be."""
    from velod.sim import simulated_recording

    settings = settings_of(config, calibration="")  # the simulated rig brings its own
    with Bar(f"simulating {seconds:g} s of {name}") as bar:
        path = simulated_recording(name, seconds, seed, bar.show)
    print(f"{seconds:g} s of {name} in real time: a driver, ingest, flow, depth, optimizer", file=sys.stderr)
    played = play(settings, str(path), PlayOptions())
    metrics = metrics_of(played)
    assert metrics is not None, "a simulated recording holds the truth"
    if csv is not None:
        write_csv(csv, played.velocities)
    print(summary(played, metrics), file=sys.stderr if json == "-" else sys.stdout)
    if json is not None:
        write_json(json, result_row(played, metrics))
    limit_mps = _DEMO_AVE_MPS[name.split("-")[0]]
    if missing := shortcomings(played, metrics, settings.optimizer.output_hz, limit_mps):
        raise RunFailed("; ".join(missing))
    return 0
