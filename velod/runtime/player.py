"""A driver process that plays a recording on the sensor topics: in real time, as a camera would, or lossless.

``python -P -m velod.runtime.player FILE --speed max``. Lossless playing never runs more than LEAD_NS of sensor time
ahead of the newest velocity, so that nothing has to be dropped anywhere.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from threading import Condition, Event

import zenoh

from velod.config import ZenohSettings
from velod.geometry.calibration_files import load_calibration
from velod.io import open_recording
from velod.io.packets import Chunking, repeated
from velod.runtime.callbacks import direct
from velod.runtime.health import HealthReporter
from velod.runtime.outlet import Outlet
from velod.runtime.prefetch import Prefetch
from velod.runtime.prime import prime
from velod.runtime.session import open_session
from velod.runtime.stacked import Stacked
from velod.runtime.stages import STAGES
from velod.runtime.worker import (
    EXIT_USAGE,
    prepare_process,
    start_logging,
    stop_on_signals,
    worker_arguments,
    worker_parser,
    zenoh_settings,
)
from velod.types import NS_PER_S, EventPacket, ImuPacket, Velocity
from velod.wire import WireError, decode
from velod.wire.topics import ALIVE, EVENTS, HEALTH, IMU_SENSOR, VELOCITY, key, parts

LEAD_NS = 300_000_000
"""Lossless: how far ahead of the newest velocity, in sensor time."""
STALL_S = 10.0
"""Without progress for so long the service is said to be stuck."""
SETTLE_S = 0.4
"""Between a player's start, which costs both cores for a moment, and its first packet."""
QUIET_S = 0.5
"""No velocity for so long after the last packet: that was the last one."""
START_S = 180.0
"""A service whose kernels must be compiled first takes a while to come up."""
PREFETCH_S = 30.0
"""So long may reading ahead take before real-time playing starts."""
TAIL_NS = 150_000_000
"""The last velocity lies at most so far before the end of the data."""

log = logging.getLogger("velod")


class PlayerError(RuntimeError):
    """Playing cannot go on; the text says why."""


class Service(Stacked):
    """What a player sees of the service: which stages are alive, and the newest velocity. A context manager."""

    def __init__(self, session: zenoh.Session, rig: str) -> None:
        self._session, self._rig = session, rig
        self._alive: set[tuple[str, str]] = set()
        self._changed = Condition()
        self.velocity_t_ns = 0
        self.heard_s = 0.0  # when the newest velocity came

    def _open(self, stack: ExitStack) -> None:
        callback = direct(self._on_token)
        tokens = self._session.liveliness().declare_subscriber(key(ALIVE, self._rig), callback, history=True)
        stack.enter_context(tokens)
        callback = direct(self._on_velocity)
        stack.enter_context(self._session.declare_subscriber(key(VELOCITY, self._rig), callback))

    def wait_until_up(self, stop: Event, timeout_s: float = START_S) -> None:
        """Wait for all stages. Raises PlayerError naming those that are missing."""
        deadline_s = time.monotonic() + timeout_s
        while not stop.is_set():
            with self._changed:
                missing = [s for s in STAGES if s not in {stage for stage, _ in self._alive}]
                if not missing:
                    return
                if time.monotonic() > deadline_s:
                    raise PlayerError(
                        f"rig {self._rig}: no {', '.join(missing)} worker is up after {timeout_s:.0f} s"
                    )
                self._changed.wait(0.1)

    def wait_for_velocity(self, t_ns: int, stop: Event) -> None:
        """Wait until a velocity at ``t_ns`` or later was heard. Raises PlayerError after STALL_S without any new."""
        started_s = time.monotonic()
        with self._changed:
            while self.velocity_t_ns < t_ns and not stop.is_set():
                self._changed.wait(0.1)
                if time.monotonic() - max(self.heard_s, started_s) > STALL_S:
                    raise PlayerError(
                        f"no progress for {STALL_S:.0f} s: the newest velocity is at {self.velocity_t_ns * 1e-9:.3f}"
                        f" s of sensor time, {t_ns * 1e-9:.3f} s is waited for"
                    )

    def wait_until_quiet(self, stop: Event) -> None:
        """Wait until no velocity has come for QUIET_S."""
        started_s = time.monotonic()
        while not stop.is_set() and time.monotonic() - max(self.heard_s, started_s) < QUIET_S:
            time.sleep(0.02)

    def _on_token(self, sample: zenoh.Sample) -> None:
        token = parts(ALIVE, str(sample.key_expr))
        with self._changed:
            change = self._alive.add if sample.kind == zenoh.SampleKind.PUT else self._alive.discard
            change((token["stage"], token["worker"]))
            self._changed.notify_all()

    def _on_velocity(self, sample: zenoh.Sample) -> None:
        try:
            message = decode(sample.payload.to_bytes(), Velocity).message
        except WireError:
            return  # not for a player to judge: consumers count it
        with self._changed:
            self.velocity_t_ns, self.heard_s = message.t_ns, time.monotonic()
            self._changed.notify_all()


def play(
    session: zenoh.Session,
    rig: str,
    packets: Iterable[EventPacket | ImuPacket],
    speed: float | None,
    stop: Event,
    name: str = "player",
) -> None:
    """Publish packets, given in sensor-time order: ``speed`` 1.0 is real time, None lossless.

    Waits for the service first, and for its last velocity in the end. Raises PlayerError.
    """
    with ExitStack() as stack:
        service = stack.enter_context(Service(session, rig))
        outlet = stack.enter_context(Outlet(session, rig, lossless=speed is None))
        service.wait_until_up(stop)
        outlet.wait_for_subscriber(IMU_SENSOR, STALL_S)
        outlet.wait_for_subscriber(EVENTS, STALL_S, camera="left")
        outlet.wait_for_subscriber(EVENTS, STALL_S, camera="right")
        stack.enter_context(prime(session, rig))
        stop.wait(SETTLE_S)
        health = HealthReporter("driver", name)
        pace = _Pace(service, speed, stop)
        last_t_ns: dict[str, int] = {}
        for packet in packets:
            pace.wait(packet.t_ns)
            if stop.is_set():
                return
            last_t_ns[_publish(outlet, packet)] = packet.t_ns
            if health.due_in_s() == 0.0:
                outlet.publish(HEALTH, health.report(packet.t_ns, outlet.counters, {}), worker=name)
        if speed is None and last_t_ns:
            service.wait_for_velocity(min(last_t_ns.values()) - TAIL_NS, stop)
        service.wait_until_quiet(stop)
        log.info("played; at the latest %.0f ms behind time", pace.latest_s * 1e3)


class _Pace:
    """When the next packet may go out."""

    def __init__(self, service: Service, speed: float | None, stop: Event) -> None:
        self._service, self._speed, self._stop = service, speed, stop
        self._first: tuple[int, float] | None = None
        self.latest_s = 0.0

    def wait(self, t_ns: int) -> None:
        if self._first is None:
            self._first = (t_ns, time.monotonic())
        first_t_ns, first_s = self._first
        if self._speed is None:
            if t_ns > first_t_ns + LEAD_NS:
                self._service.wait_for_velocity(t_ns - LEAD_NS, self._stop)
            return
        due_s = first_s + (t_ns - first_t_ns) / (NS_PER_S * self._speed)
        if (early_s := due_s - time.monotonic()) > 0.0:
            self._stop.wait(early_s)
        self.latest_s = max(self.latest_s, -early_s)


def _publish(outlet: Outlet, packet: EventPacket | ImuPacket) -> str:
    """Returns the stream that the packet belongs to."""
    if isinstance(packet, EventPacket):
        outlet.publish(EVENTS, packet, camera=packet.camera)
        return packet.camera
    outlet.publish(IMU_SENSOR, packet)
    return "imu"


def player_command(
    recording: str,
    settings: ZenohSettings,
    rig: str,
    speed: float | None = 1.0,
    packets: str = "200hz",
    calibration: str = "",
) -> list[str]:
    """The command line that plays a recording to the service with these settings.

    ``calibration``: the file that stands in for the recording's own; empty: none does.
    """
    said = "max" if speed is None else f"{speed:g}"
    command = [sys.executable, "-P", "-m", "velod.runtime.player", recording, "--speed", said, "--packets", packets]
    if calibration:
        command += ["--calibration", calibration]
    return [*command, *worker_arguments(replace(settings, lossless=speed is None), rig, "player-0")]


def _speed(text: str) -> float | None:
    if text == "max":
        return None
    value = float(text)
    if not 0.001 <= value <= 1000.0:
        raise ValueError(text)
    return value


def _chunking(text: str) -> Chunking:
    try:
        return Chunking.parse(text)
    except ValueError as e:
        raise argparse.ArgumentTypeError(str(e)) from None


def main(argv: Sequence[str] | None = None) -> int:
    """Play one recording; returns the exit code."""
    parser = worker_parser("python -P -m velod.runtime.player", worker="player-0")
    parser.description = "Plays a recording on the sensor topics of a velod service, as a camera driver would."
    parser.add_argument("recording", help="a sequence file (HDF5) or a folder that velod reads")
    parser.add_argument("--speed", type=_speed, default=1.0, help="1.0: real time; max: lossless, as fast as it goes")
    parser.add_argument(
        "--packets", type=_chunking, default=Chunking(), help="200hz, 1000hz, 60hz, random, random:SEED"
    )
    parser.add_argument("--repeat", type=float, default=1.0, metavar="N", help="rounds, inf: for ever (default 1)")
    parser.add_argument("--calibration", metavar="FILE", help="in place of the recording's own, which it may lack")
    args = parser.parse_args(argv)
    start_logging(args.worker)
    try:
        prepare_process(args.parent)
        stop = stop_on_signals()
        calibration = load_calibration(args.calibration) if args.calibration else None
        packets = open_recording(args.recording, calibration=calibration).packets(args.packets)
        if args.repeat == 1.0:
            ahead = Prefetch(packets)
            if args.speed is not None:
                ahead.fill(PREFETCH_S)
        stream = ahead if args.repeat == 1.0 else repeated(list(packets), args.repeat)
        with open_session(zenoh_settings(args)) as session:
            play(session, args.rig, stream, args.speed, stop, args.worker)
    except PlayerError as e:
        log.error("%s", e)
        return 1
    except (OSError, ValueError) as e:
        log.error("%s", e)
        return EXIT_USAGE
    return 0


if __name__ == "__main__":
    sys.exit(main())
