"""``velod run`` and ``velod warmup``."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

from velod.cli.config import calibration_of, settings_of
from velod.config import ConfigError, Settings


def run(
    config: str | None,
    calibration_file: str | None,
    only: list[str] | None,
    connect: str | None,
    worker: str | None,
    keys: str | None,
    *,
    insecure: bool,
) -> int:
    """Keep the service's processes alive until SIGINT or SIGTERM. Raises ConfigError, SessionError, ..."""
    settings = settings_of(config, calibration_file)
    zenoh = replace(
        settings.zenoh,
        connect=connect or settings.zenoh.connect,
        keys=keys or settings.zenoh.keys,
        insecure=insecure or settings.zenoh.insecure,
    )
    asks = zenoh.config or any(end.startswith(("tls/", "quic/")) for end in (zenoh.listen, zenoh.connect))
    if keys and not asks:
        raise ConfigError("--keys goes with a tls/ endpoint: zenoh.listen, or --connect")
    settings = replace(settings, zenoh=zenoh)
    calibration = calibration_of(settings)
    if calibration is None and not settings.zenoh.connect:
        raise ConfigError(
            f"{config or 'defaults'}: rig.calibration: missing; the service beside a sensor needs it or --calibration"
        )
    from velod.runtime.custody import OUTLIVE_S
    from velod.runtime.stages import STAGES
    from velod.runtime.supervisor import Supervisor
    from velod.runtime.worker import start_logging, stop_on_signals

    start_logging("supervisor")
    stop = stop_on_signals()
    with Supervisor(settings, calibration, only or STAGES, worker or "", outlive_s=OUTLIVE_S) as supervisor:
        supervisor.run(stop)
    return 0


def warmup() -> int:
    """Compile and cache the kernels of all stages and of the simulator."""
    from velod.runtime.kernel_cache import confirm_kernels
    from velod.runtime.warmup import fill_cache
    from velod.sim import sequence, simulate

    start_s = time.monotonic()
    fill_cache(Settings())
    with tempfile.TemporaryDirectory() as directory:
        simulate(sequence("corridor-1"), 0.01, 1, Path(directory) / "warmup.h5")
    confirm_kernels()
    print(f"kernels ready after {time.monotonic() - start_s:.1f} s")
    return 0
