"""``velod view``: selected events, flow, depth and velocity of a running velod, for the Rerun viewer."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections import OrderedDict
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from velod.cli.exit import EXIT_FAILED
from velod.cli.place import Way, place_of
from velod.client import Listener
from velod.optimizer.flow_equation import pairs
from velod.optimizer.parts import Parts, batch_seq
from velod.types import NS_PER_S, DepthBatch, EventBatch, FlowBatch, Message, Odometry, Velocity
from velod.wire.topics import BATCH_FLOW, DEPTH, FLOW, ODOMETRY, VELOCITY

TOPICS = (BATCH_FLOW, FLOW, DEPTH, VELOCITY, ODOMETRY)
ARROW_S = 0.02
"""A flow arrow is as long as the edge moves in this time."""
NEAREST_M = 1.0
"""Depths are red from here on, and the bluer the farther."""
SIGMAS = 3.0
_REMEMBERED = 32
_OFF, _ON = (80, 120, 255), (255, 90, 80)
_POLL_S = 0.5


class Scene:
    """Logs messages to a Rerun recording, on the timeline of the sensor's time.

    ``image/events`` are sensor pixels, ``image/flow`` and ``image/depth`` those of the rectified left image.
    """

    def __init__(self, recording: Any) -> None:
        import rerun

        self._rr, self._rec = rerun, recording
        self._parts: OrderedDict[int, Parts] = OrderedDict()  # by batch, until all of it is there
        for axis, colour in zip("xyz", ((255, 80, 80), (80, 200, 80), (80, 120, 255)), strict=True):
            dim = tuple(c // 2 for c in colour)
            line = rerun.SeriesLines(colors=[colour, dim, dim], names=[f"v{axis}", "- 3 sigma", "+ 3 sigma"])
            recording.log(f"velocity/{axis}", line, static=True)

    def log(self, message: Message) -> None:
        """Show one message; kinds that are not shown are passed over."""
        self._rec.set_time("sensor", duration=message.t_ns / NS_PER_S)
        if isinstance(message, EventBatch):
            self._log_events(message)
        elif isinstance(message, FlowBatch | DepthBatch):
            if isinstance(message, FlowBatch):
                self._log_flow(message)
            self._join(message)
        elif isinstance(message, Velocity):
            self._log_velocity(message)
        elif isinstance(message, Odometry):
            self._rec.log("path", self._rr.Points3D([message.p_OB]))

    def _log_events(self, batch: EventBatch) -> None:
        colours = np.where(batch.p[:, None] > 0, np.array(_ON, np.uint8), np.array(_OFF, np.uint8))
        at = np.stack([batch.x, batch.y], axis=1)
        self._rec.log("image/events", self._rr.Points2D(at, colors=colours, radii=0.7))

    def _log_flow(self, flow: FlowBatch) -> None:
        at, arrows = np.stack([flow.x, flow.y], axis=1), ARROW_S * flow.speed[:, None] * flow.n
        # The surer a flow, the more opaque its arrow.
        colours = _with_alpha((255, 220, 90), flow.sigma / flow.speed, 0.2)
        self._rec.log("image/flow", self._rr.Arrows2D(vectors=arrows, origins=at, colors=colours))

    def _join(self, part: FlowBatch | DepthBatch) -> None:
        """Depths have their place from the flow at the same event, which may come before or after."""
        parts = self._parts.setdefault(batch_seq(part), Parts())
        parts.add(part)
        if (depth := parts.whole) is not None:
            self._log_depth(parts.joined(depth), depth)
            del self._parts[depth.seq]
        while len(self._parts) > _REMEMBERED:
            self._parts.popitem(last=False)

    def _log_depth(self, flow: FlowBatch, depth: DepthBatch) -> None:
        at_flow, at_depth = pairs(flow.index, depth.index)
        inv_depth, sigma = depth.inv_depth[at_depth], depth.sigma[at_depth]
        near = np.clip(NEAREST_M * inv_depth, 0.0, 1.0)[:, None]
        rgb = (near * np.array(_ON) + (1.0 - near) * np.array(_OFF)).astype(np.uint8)
        alpha = _with_alpha((0, 0, 0), sigma / inv_depth, 0.2)[:, 3:]
        at = np.stack([flow.x[at_flow], flow.y[at_flow]], axis=1)
        self._rec.log("image/depth", self._rr.Points2D(at, colors=np.hstack([rgb, alpha]), radii=1.5))

    def _log_velocity(self, velocity: Velocity) -> None:
        if not velocity.valid:
            return
        band = SIGMAS * np.sqrt(np.diag(velocity.cov))
        for i, axis in enumerate("xyz"):
            v, three_sigma = float(velocity.v_B[i]), float(band[i])
            self._rec.log(f"velocity/{axis}", self._rr.Scalars([v, v - three_sigma, v + three_sigma]))


def _with_alpha(rgb: tuple[int, int, int], share: Any, unsure: float) -> Any:
    """(n, 4) uint8: opaque where the relative sigma ``share`` (n,) is 0, faint where it reaches ``unsure``."""
    alpha = 255.0 * np.clip(1.0 - np.asarray(share, np.float64) / unsure, 0.1, 1.0)
    out = np.tile(np.array([*rgb, 0], np.uint8), (len(alpha), 1))
    out[:, 3] = alpha.astype(np.uint8)
    return out


def view(config: str | None, way: Way, save: str | None, seconds: float | None, port: int) -> int:
    """Show, or write to ``save``, what comes, for ``seconds`` or until it is stopped; 1 where nothing came."""
    keep_to_ourselves()
    try:
        import rerun
    except ImportError:
        raise ValueError("velod view needs the Rerun SDK: pip install 'velod[view]'") from None
    place = place_of(config, way, "operator")
    recording = rerun.RecordingStream("velod")
    with ExitStack() as stack:
        if save is not None:
            recording.save(save)
        else:
            _open_viewer(port)
            recording.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy")
        listener = stack.enter_context(Listener(place.rig, TOPICS, place.zenoh))
        scene, shown = Scene(recording), 0
        end_s = time.monotonic() + (math.inf if seconds is None else seconds)
        while (left_s := end_s - time.monotonic()) > 0.0:
            received = listener.receive(min(_POLL_S, left_s))
            if received is not None:
                scene.log(received.envelope.message)
                shown += 1
        recording.flush()
        recording.disconnect()
    if not shown:
        print(f"velod: nothing of rig {place.rig} in {seconds:g} s ({place.connect})", file=sys.stderr)
        return EXIT_FAILED
    print(f"{shown} messages" + ("" if save is None else f" in {save}"))
    return 0


def keep_to_ourselves() -> None:
    """Rerun's settings from a folder of velod's own, in which its analytics are off. Call before importing it."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "velod" / "rerun"
    os.environ["XDG_CONFIG_HOME"], os.environ["XDG_DATA_HOME"] = str(base / "config"), str(base / "data")
    if not (base / "config" / "rerun" / "analytics.json").exists():
        command = [sys.executable, "-m", "rerun", "analytics", "disable"]
        subprocess.run(command, check=False, capture_output=True)


def _open_viewer(port: int) -> None:
    """The viewer's window, a process of its own that stays open at the end; it listens on loopback only."""
    command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", str(port), "--memory-limit", "2GB"]
    subprocess.Popen(command, start_new_session=True)
