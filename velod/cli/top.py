"""``velod top``: a table of a running velod's processes, from the health that they send."""

from __future__ import annotations

import sys
import time

from velod.cli.exit import EXIT_FAILED
from velod.cli.place import Place, Way, place_of
from velod.client import Listener, Received
from velod.runtime.dispatching import SENT
from velod.types import Health
from velod.wire.topics import HEALTH

_CLEAR_SCREEN = "\x1b[H\x1b[2J"
_REFRESH_S = 1.0
_DISCOVERY_S = 3.0
_HEADER = (
    f"{'worker':<14}{'state':<8}{'pid@host':<22}{'up s':>8}{'in/s':>8}{'out/s':>8}"
    f"{'p50 ms':>8}{'p99 ms':>8}{'gaps':>7}{'drops':>7}"
)
_LOSS_PREFIXES = (
    *("packets.", "events.", "imu.", "clock.", "batch.", "batches.", "shed."),  # refused or missed by a stage
    *("inbox.", "dispatch.", "wire.", "key.", "error.", "restart."),  # on the way between processes
)


def top(config: str | None, way: Way, *, once: bool) -> int:
    """The table of processes, drawn once a second; with ``once`` printed one time, 1 if nobody answers."""
    place = place_of(config, way, "operator")
    with Listener(place.rig, (HEALTH,), place.zenoh) as listener:
        newest: dict[str, Received] = {}
        if once:
            _collect(listener, newest, _DISCOVERY_S, until_complete=True)
            print(table(place, newest, listener.alive()))
            return 0 if newest else EXIT_FAILED
        begin = _CLEAR_SCREEN if sys.stdout.isatty() else ""
        while True:
            _collect(listener, newest, _REFRESH_S, until_complete=False)
            print(begin + table(place, newest, listener.alive()), flush=True)


def table(place: Place, newest: dict[str, Received], alive: list[tuple[str, str]]) -> str:
    """The table as text: a line per process, the drops by cause, the alarms."""
    workers = {worker for _, worker in alive}
    lines = [f"velod rig {place.rig} at {place.connect}", _HEADER]
    for worker in sorted(set(newest) | workers):
        lines += _lines(worker, newest.get(worker), worker in workers)
    if len(lines) == 2:
        lines.append("nobody there")
    return "\n".join(lines)


def shares(rates: dict[str, float]) -> list[str]:
    """Who is sent how much of each stage's batches, by ingest's health: a line per stage."""
    by_stage: dict[str, dict[str, float]] = {}
    for name, rate in sorted(rates.items()):
        if name.startswith(SENT):
            worker = name.removeprefix(SENT)
            by_stage.setdefault(worker.partition("-")[0], {})[worker] = rate
    return [
        f"    {stage}: " + ", ".join(f"{worker} {rate / sum(part.values()):.0%}" for worker, rate in part.items())
        for stage, part in by_stage.items()
    ]


def losses(counters: dict[str, int]) -> tuple[dict[str, int], dict[str, int]]:
    """The gaps and the drops among a process's counters, those above zero; what merely counts work is neither."""
    gaps = {name: n for name, n in counters.items() if n and name.startswith(("gap.", "packets.gap"))}
    drops = {name: n for name, n in counters.items() if n and name not in gaps and name.startswith(_LOSS_PREFIXES)}
    return gaps, drops


def _collect(listener: Listener, newest: dict[str, Received], seconds: float, *, until_complete: bool) -> None:
    """Take in health messages for a while, or until everyone who is alive has spoken."""
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0.0:
        received = listener.receive(min(0.2, left_s))
        if received is not None and isinstance(received.envelope.message, Health):
            newest[received.envelope.message.worker] = received
        elif until_complete and newest and {worker for _, worker in listener.alive()} <= set(newest):
            return


def _lines(worker: str, received: Received | None, alive: bool) -> list[str]:
    if received is None:
        return [f"{worker:<14}{'silent':<8}"]
    h = received.envelope.message
    assert isinstance(h, Health)
    stale = (time.time_ns() - received.t_received_ns) * 1e-9 > HEALTH.stale_after_s
    # The supervisor and drivers hold no token; for them recent health is life enough.
    state = "stale" if stale else "up" if alive or h.stage not in ("ingest", "flow", "depth", "optimizer") else "gone"
    if state == "up" and h.role:
        state = h.role
    name, p50, p99 = _main_latency(h)
    gaps, drops = losses(h.counters)
    line = (
        f"{worker:<14}{state:<8}{f'{h.pid}@{h.host}'[:21]:<22}{h.uptime_s:8.0f}{_rate(h, 'in.'):8.1f}"
        f"{_rate(h, 'out.'):8.1f}{p50:>8}{p99:>8}{sum(gaps.values()):7d}{sum(drops.values()):7d}  {name}".rstrip()
    )
    notes = [f"    {cause}: {n}" for cause, n in sorted({**gaps, **drops}.items())]
    alarms = [f"    ALARM {alarm}: {what}" for alarm, what in sorted(h.alarms.items())]
    return [line, *shares(h.rates), *notes, *alarms]


def _main_latency(h: Health) -> tuple[str, str, str]:
    """Name, p50 and p99 of the latency to show: end to end where there is one, else the first."""
    names = sorted({name.rpartition("_")[0] for name in h.latency_ms}, key=lambda n: (n != "end_to_end", n))
    for name in names:
        if f"{name}_p50" in h.latency_ms and f"{name}_p99" in h.latency_ms:
            return name, f"{h.latency_ms[f'{name}_p50']:.2f}", f"{h.latency_ms[f'{name}_p99']:.2f}"
    return "", "-", "-"


def _rate(h: Health, prefix: str) -> float:
    return sum(rate for name, rate in h.rates.items() if name.startswith(prefix))
