"""Simulated rigs that publish velocity, each with a session of its own: ``python -P -m velod.prove.fleet_rigs``.

Prints a line once all are connected, and publishes from the next line on stdin on, until SIGTERM.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from velod.config import ZenohSettings
from velod.runtime.key_paths import KeyPaths
from velod.runtime.outlet import Outlet
from velod.runtime.session import client_tree, open_config, to_config
from velod.runtime.worker import stop_on_signals
from velod.types import Velocity
from velod.wire.topics import VELOCITY


def main() -> None:
    """Connect, say so, publish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("endpoint")
    parser.add_argument("first", type=int)
    parser.add_argument("count", type=int)
    parser.add_argument("hz", type=float)
    parser.add_argument("--keys", help="folder with a worker's certificate, for a tls/ endpoint")
    args = parser.parse_args()
    stop = stop_on_signals()
    with ExitStack() as stack:
        outlets = []
        for rig in range(args.first, args.first + args.count):
            tree = client_tree(args.endpoint, KeyPaths(Path(args.keys)) if args.keys else None, "worker")
            tree["transport"]["shared_memory"]["enabled"] = False  # as from another host
            session = stack.enter_context(open_config(to_config(tree), ZenohSettings(connect=args.endpoint)))
            outlets.append(stack.enter_context(Outlet(session, f"rig{rig}")))
            outlets[-1].publisher(VELOCITY)
        print("connected", flush=True)
        sys.stdin.readline()
        publish(outlets, args.hz, stop)


def publish(outlets: list[Outlet], hz: float, stop: threading.Event) -> None:
    """Each rig ``hz`` times a second, evenly spread over the period, as rigs that know nothing of each other."""
    start_s = time.monotonic()
    v, cov = np.array([1.0, 0.0, 0.0]), 1e-4 * np.eye(3)
    for n in range(sys.maxsize):
        due_s = start_s + n / (hz * len(outlets))
        if (early_s := due_s - time.monotonic()) > 0.0 and stop.wait(early_s):
            return
        if stop.is_set():
            return
        seq, rig = divmod(n, len(outlets))
        outlets[rig].publish(VELOCITY, Velocity(seq, int(seq / hz * 1e9), v, cov, True, "tracking", "", seq, 0))


if __name__ == "__main__":
    main()
