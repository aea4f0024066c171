"""A made-up stream through all processes of a service, for ``velod bench``."""

from __future__ import annotations

import socket
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from velod.cli.exit import RunFailed
from velod.config import Settings
from velod.eval.bench_input import RIG, SPEED_PX_S, record
from velod.geometry.calibration import Calibration
from velod.runtime.online import OnlineError, OnlineResult, run_online
from velod.runtime.player import player_command


def through_the_processes(
    settings: Settings,
    seconds: float,
    speed: float | None,
    packets: str = "200hz",
    speed_px_s: float = SPEED_PX_S,
    rig: Calibration = RIG,
    **listening: Any,
) -> tuple[OnlineResult, int]:
    """Play the benchmark's stream through all processes; what came out, and how many events went in.

    Raises RunFailed, SessionError.
    """
    zenoh, name = replace(settings.zenoh, port=free_port()), replace(settings.rig, name="bench")
    trouble: list[str] = []
    with TemporaryDirectory() as directory:
        path = Path(directory) / "stream.h5"
        events = record(path, seconds, seed=1, speed_px_s=speed_px_s, rig=rig)
        driver = player_command(str(path), zenoh, name.name, speed, packets)
        try:
            result = run_online(
                replace(settings, zenoh=zenoh, rig=name), rig, driver, on_line=trouble.append, **listening
            )
        except OnlineError as e:
            raise RunFailed(str(e)) from None
    out = result.velocities
    if len(out) < 2 or out[-1].t_pub_ns == out[0].t_pub_ns:
        raise RunFailed("the processes put out nothing: " + "; ".join(trouble[-3:]))
    return result, events


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port: int = s.getsockname()[1]
        return port
