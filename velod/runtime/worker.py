"""A worker process: command line, signals, settings from the service, stage, shell."""

from __future__ import annotations

import argparse
import gc
import logging
import os
import signal
import socket
import sys
from collections.abc import Sequence
from threading import Event, Thread

import zenoh

from velod.config import Settings, ZenohSettings
from velod.runtime.access import ROLES
from velod.runtime.custody import Place, identity, live_in_custody
from velod.runtime.heap import keep_memory
from velod.runtime.kernel_cache import ensure_cache_directory
from velod.runtime.parent import die_with
from velod.runtime.session import introducer_endpoint, open_session
from velod.runtime.settings_service import fetch
from velod.runtime.stages import Stage, create_stage, stage_of

EXIT_USAGE = 2
_SWITCH_INTERVAL_S = 0.0005

log = logging.getLogger("velod")


def main(stage: str, argv: Sequence[str] | None = None) -> int:
    """Run one worker of ``stage`` until SIGTERM or SIGINT; returns the exit code."""
    args = worker_parser(f"python -P -m velod.workers.{stage}", worker=f"{stage}-0").parse_args(argv)
    start_logging(args.worker)
    from velod.runtime import warmup  # kernels, which the supervisor has no use for

    try:
        if stage_of(args.worker) != stage:
            raise ValueError(f"--worker {args.worker}: must be {stage}-<number>")
        prepare_process(args.parent)
        stop = stop_on_signals()
        with open_session(zenoh_settings(args)) as session:
            settings, calibration = fetch(session, args.rig, args.connect)
            built = create_stage(stage, settings, calibration)
            warmup.warm_up(stage, settings, calibration)
            enter_custody(args, args.worker, identity(settings, calibration), stop)
            serve_stage(session, settings, args.worker, built, stop)
    except (OSError, ValueError) as e:
        log.error("%s", e)
        return EXIT_USAGE
    return 0


def serve_stage(session: zenoh.Session, settings: Settings, worker: str, stage: Stage, stop: Event) -> None:
    """Handle messages as ``worker`` until ``stop`` is set."""
    from velod.runtime.roles import SHELLS

    # What was made until now lives as long as the process: the collector need not look at it again.
    gc.collect()
    gc.freeze()
    name = stage_of(worker)
    SHELLS[name](session, settings, name, worker, stage).run(stop)


def enter_custody(args: argparse.Namespace, worker: str, who: bytes, stop: Event) -> None:
    """Be a worker that outlives its supervisor, if the arguments say so. Raises OSError where it is there already."""
    live_in_custody(Place(args.connect, args.rig), worker, args.parent, args.outlive, who, stop)


def worker_arguments(settings: ZenohSettings, rig: str, worker: str, outlive_s: float = 0.0) -> list[str]:
    """The command line of a worker that belongs to a service with these settings."""
    arguments = ["--connect", introducer_endpoint(settings), "--rig", rig, "--worker", worker]
    arguments += ["--parent", str(os.getpid()), "--outlive", f"{outlive_s:g}"]
    if settings.listen:
        arguments += ["--listen", settings.listen]
    if settings.keys:
        arguments += ["--keys", settings.keys, "--role", settings.role]
    if settings.insecure:
        arguments.append("--insecure")
    if settings.config:
        arguments += ["--zenoh-config", settings.config]
    if settings.lossless:
        arguments.append("--lossless")
    return arguments if settings.shared_memory else [*arguments, "--no-shared-memory"]


def zenoh_settings(args: argparse.Namespace) -> ZenohSettings:
    """The settings of a worker's session, from its command line."""
    return ZenohSettings(
        connect=args.connect,
        listen=args.listen,
        keys=args.keys,
        role=args.role,
        insecure=args.insecure,
        config=args.zenoh_config,
        shared_memory=not args.no_shared_memory,
        lossless=args.lossless,
    )


def worker_parser(program: str, worker: str) -> argparse.ArgumentParser:
    """The command line that ``worker_arguments`` writes; ``worker`` is the default name."""
    parser = argparse.ArgumentParser(
        program, description="One worker of a velod service; `velod run` starts it, or you do, on any host."
    )
    default = introducer_endpoint(ZenohSettings())
    parser.add_argument(
        "--connect", default=default, help=f"endpoint of the service's introducer (default {default})"
    )
    parser.add_argument("--rig", default="rig0", help="name of the rig (default rig0)")
    parser.add_argument("--worker", default=worker, help="this worker's name, <stage>-<number>, one of its kind")
    parser.add_argument("--listen", default="", help="endpoint on which other hosts reach this process; any port")
    parser.add_argument("--keys", default="", help="folder with the certificates for tls/ endpoints")
    parser.add_argument("--role", default="worker", choices=ROLES, help="whose certificate to show (default worker)")
    parser.add_argument("--insecure", action="store_true", help="allow tcp/ endpoints beyond this host")
    parser.add_argument("--zenoh-config", default="", help="a zenoh configuration file (JSON5) instead")
    parser.add_argument("--no-shared-memory", action="store_true", help="TCP only, within this host as well")
    parser.add_argument("--lossless", action="store_true", help="replay: keep a link that blocks for longer")
    parser.add_argument("--parent", type=int, default=0, help="process id of the supervisor, to die with it")
    parser.add_argument("--outlive", type=float, default=0.0, help="seconds for which to wait for another supervisor")
    return parser


def start_logging(worker: str) -> None:
    """Log lines on stderr, with the time and the worker's name."""
    logging.basicConfig(
        level=logging.INFO,
        stream=sys.stderr,
        format=f"%(asctime)s.%(msecs)03d {worker} %(levelname)s %(message)s",
        datefmt="%H:%M:%S",
        force=True,
    )


def prepare_process(parent: int) -> None:
    """Die with the parent (Linux), hand the interpreter lock over quickly, find a place for compiled kernels."""
    die_with(parent)
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    keep_memory()
    ensure_cache_directory()


def stop_on_signals() -> Event:
    """An event that SIGTERM and SIGINT set, at once, whatever the main thread waits for.

    The kernel may give a signal to one of the network's threads. Python runs handlers in the main thread alone, and
    nothing wakes that from a wait: the service would go on until its wait is over.
    """
    stop = Event()
    told, tells = socket.socketpair()
    tells.setblocking(False)
    signal.set_wakeup_fd(tells.detach(), warn_on_full_buffer=False)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    Thread(target=_set_when_told, args=(stop, told), name="signals", daemon=True).start()
    return stop


def _set_when_told(stop: Event, told: socket.socket) -> None:
    with told:
        while told.recv(1)[0] not in (signal.SIGTERM, signal.SIGINT):
            pass  # of another signal that has a handler
    stop.set()
