"""The supervisor of ``velod run``: introducer, server of settings, and the one who restarts what dies.

Every worker gets settings and calibration over Zenoh, so a worker on another host starts the same way as one here.
One warm spare process stands by: a dead worker is replaced by it at once, and a new spare is made ready. Workers of a
supervisor that was killed go on, where that was asked for, and the next one takes them over (``adoption``).
"""

from __future__ import annotations

import logging
import socket
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from threading import Event, Lock
from typing import Any

import zenoh

from velod.config import Settings
from velod.geometry.calibration import Calibration
from velod.runtime.adoption import adopt
from velod.runtime.callbacks import direct
from velod.runtime.custody import Place, identity
from velod.runtime.health import HealthReporter
from velod.runtime.outlet import Outlet
from velod.runtime.pools import PoolKeeper
from velod.runtime.process import AdoptedProcess, ChildProcess, LineSink, WatchedProcess, stop_all, to_stderr
from velod.runtime.session import introducer_endpoint, open_session
from velod.runtime.settings_service import fetch, serve
from velod.runtime.spare import READY
from velod.runtime.stacked import Stacked
from velod.runtime.stages import STAGES, stage_of, worker_names
from velod.runtime.worker import worker_arguments
from velod.wire.topics import ALIVE, HEALTH, key, parts

log = logging.getLogger("velod.supervisor")

POLL_S = 0.02
FIRST_DELAY_S, LAST_DELAY_S = 0.1, 10.0
STEADY_S = 10.0
"""A worker that lived so long starts with no delay again."""
HEAD_START_S = 30.0
"""So long at the most do a stage's further workers wait for the first of each: all at once, all would come late.
Then they load with low priority, or those that work already could not keep up meanwhile."""
REMEMBERED_S = 60.0
"""A death stays an alarm in health for so long."""


@dataclass(slots=True)
class _Slot:
    """A worker that is to be there, and the process that is it now."""

    worker: str
    is_further: bool = False  # of its stage, so that others work while it starts for the first time
    process: WatchedProcess | None = None
    restarts: int = 0
    quick_deaths: int = 0  # in a row, each soon after its start
    due_s: float = 0.0  # when to start the next one
    died_s: float = 0.0
    last_death: str = ""


class Supervisor(Stacked):
    """A context manager that starts the workers and stops them; in between call ``step`` often, or ``run``."""

    def __init__(
        self,
        settings: Settings,
        calibration: Calibration | None,
        stages: Sequence[str] = STAGES,
        worker: str = "",
        spare: bool = True,
        on_line: LineSink = to_stderr,
        outlive_s: float = 0.0,
    ) -> None:
        """``stages``: which of them run here. ``worker``: the name of the only one. ``calibration`` may be None
        where ``settings.zenoh.connect`` names another host's service, which is then asked for both. ``outlive_s``:
        so long do workers outlive a supervisor that was killed, for another one to take them over; not where the
        service is another host's, or is reached by a configuration of the user's. Raises ValueError for names that
        are none.
        """
        unknown = set(stages) - set(STAGES)
        if unknown or not stages:
            raise ValueError(f"unknown stage {', '.join(sorted(unknown))}; stages: {', '.join(STAGES)}")
        if worker and tuple(stages) != (stage_of(worker),):
            raise ValueError(f"worker {worker}: goes with its one stage: --only {stage_of(worker)}")
        if calibration is None and not settings.zenoh.connect:
            raise ValueError("a calibration is needed where no other service is connected to (rig.calibration)")
        self._settings, self._calibration = settings, calibration
        self._stages, self._worker, self._wants_spare = tuple(stages), worker, spare
        self._on_line = on_line
        # Whoever has the introducer's port is the only supervisor.
        self._is_alone = not (settings.zenoh.connect or settings.zenoh.config)
        self._outlive_s = outlive_s if self._is_alone else 0.0
        self._slots: dict[str, _Slot] = {}
        self._further: list[_Slot] = []  # not yet started: a stage's second workers and so on
        self._spare: ChildProcess | None = None
        self._spare_is_known = False  # to be ready: said once
        self._alive: set[tuple[str, str]] = set()
        self._alive_lock = Lock()
        self._name = f"supervisor-{socket.gethostname().split('.')[0]}" if settings.zenoh.connect else "supervisor"
        self._health = HealthReporter("supervisor", self._name)
        self._pools = PoolKeeper(takes_large=False)
        self.session: Any = None

    def _open(self, stack: ExitStack) -> None:
        """Open the session, serve the settings, start the workers. Raises SessionError, NoServiceError."""
        zenoh_settings = self._settings.zenoh
        self.session = stack.enter_context(
            open_session(zenoh_settings, not zenoh_settings.connect, (self._settings.rig.name,))
        )
        self._settings_from_service(stack)
        # Health is for whoever can follow, even in a lossless replay.
        self._outlet = stack.enter_context(Outlet(self.session, self._settings.rig.name))
        self._watch_liveliness(stack)
        stack.callback(self.stop_workers)
        left_behind = self._left_behind(names := self._names())
        for name in names:
            is_further = name not in left_behind and stage_of(name) in map(stage_of, self._slots)
            self._slots[name] = slot = _Slot(name, is_further, left_behind.get(name))
            if slot.is_further:
                slot.due_s = time.monotonic() + HEAD_START_S
                self._further.append(slot)
        self.step()

    def run(self, stop: Event) -> None:
        """Keep the workers alive until ``stop`` is set."""
        while not stop.wait(POLL_S):
            self.step()

    def step(self) -> None:
        """Restart what has died, keep a spare, report health once a second."""
        if self._further and self._firsts_are_up():
            for slot in self._further:
                slot.due_s = 0.0
            self._further.clear()
        for slot in self._slots.values():
            if slot.process is not None and slot.process.exit_code() is not None:
                self._bury(slot)
            if slot.process is None and time.monotonic() >= slot.due_s:
                self._start(slot)
        self._keep_a_spare()
        if self._health.due_in_s() == 0.0:
            self._pools.look(time.monotonic())
            health = self._health.report(0, self._counters(), self._alarms())
            self._outlet.publish(HEALTH, health, worker=self._name)

    def is_up(self, stages: Sequence[str] = STAGES) -> bool:
        """Whether every worker of this supervisor, and one of each of ``stages`` anywhere, is alive."""
        with self._alive_lock:
            alive = set(self._alive)
        return {stage_of(w) for _, w in alive} >= set(stages) and {w for _, w in alive} >= set(self._slots)

    def _firsts_are_up(self) -> bool:
        """Whether all but those that wait for them are alive."""
        with self._alive_lock:
            alive = {worker for _, worker in self._alive}
        return alive >= set(self._slots) - {slot.worker for slot in self._further}

    def trouble(self, deaths: int = 3) -> str:
        """Which worker does not stay alive, and why; empty while none has died ``deaths`` times in a row."""
        bad = [
            f"{s.worker} does not stay alive: {s.last_death}"
            for s in self._slots.values()
            if s.quick_deaths >= deaths
        ]
        return bad[0] if bad else ""

    def stop_workers(self) -> None:
        """End all workers and start none any more; the session stays open for their last words."""
        children: list[WatchedProcess] = [s.process for s in self._slots.values() if s.process is not None]
        stop_all(children if self._spare is None else [*children, self._spare])
        self._slots.clear()
        self._spare, self._wants_spare = None, False

    def process_ids(self) -> dict[str, int]:
        """Process ids of the workers that run now."""
        return {s.worker: s.process.pid for s in self._slots.values() if s.process is not None}

    @property
    def spare_is_ready(self) -> bool:
        """Whether a worker that dies now is replaced at once."""
        return self._spare is not None and self._spare.has_said(READY)

    @property
    def spare_is_settled(self) -> bool:
        """Whether the spare is ready, or none is wanted: loading it takes time from the others."""
        return self.spare_is_ready or not self._wants_spare

    def restarts(self) -> dict[str, int]:
        """How often each worker was restarted."""
        return {s.worker: s.restarts for s in self._slots.values()}

    def _settings_from_service(self, stack: ExitStack) -> None:
        """Serve settings and calibration; or, connected to another host's service, take them from there."""
        s = self._settings
        if self._calibration is not None and not s.zenoh.connect:
            stack.enter_context(serve(self.session, s, self._calibration))
            return
        served, self._calibration = fetch(self.session, s.rig.name, introducer_endpoint(s.zenoh))
        # How to reach the service is this host's own affair.
        self._settings = replace(served, zenoh=s.zenoh)

    def _names(self) -> list[str]:
        if self._worker:
            return [self._worker]
        names = []
        for stage in self._stages:
            wanted = worker_names(self._settings, stage)
            names += self._free_names(stage, len(wanted)) if self._settings.zenoh.connect else wanted
        return names

    def _left_behind(self, names: Sequence[str]) -> dict[str, AdoptedProcess]:
        """Workers that a supervisor before this one has left at work; none stays that is none of this one's."""
        if not self._is_alone or self._calibration is None:
            return {}
        place = Place(introducer_endpoint(self._settings.zenoh), self._settings.rig.name)
        wanted = names if self._outlive_s else ()
        adopted = adopt(place, wanted, identity(self._settings, self._calibration), self._on_line)
        for name, process in adopted.items():
            log.warning("%s: process %d, left at work by another supervisor, goes on", name, process.pid)
        return adopted

    def _free_names(self, stage: str, count: int) -> list[str]:
        """Names that nobody has at the service that is connected to."""
        replies = self.session.liveliness().get(key(ALIVE, self._settings.rig.name, stage=stage), timeout=1.0)
        taken = {parts(ALIVE, str(reply.ok.key_expr))["worker"] for reply in replies if reply.ok is not None}
        return [name for i in range(count + len(taken)) if (name := f"{stage}-{i}") not in taken][:count]

    def _watch_liveliness(self, stack: ExitStack) -> None:
        def changed(sample: zenoh.Sample) -> None:
            token = parts(ALIVE, str(sample.key_expr))
            with self._alive_lock:
                change = self._alive.add if sample.kind == zenoh.SampleKind.PUT else self._alive.discard
                change((token["stage"], token["worker"]))

        watch = self.session.liveliness().declare_subscriber(
            key(ALIVE, self._settings.rig.name), direct(changed), history=True
        )
        stack.enter_context(watch)

    def _command(self, module: str, worker: str) -> list[str]:
        arguments = worker_arguments(self._settings.zenoh, self._settings.rig.name, worker, self._outlive_s)
        return [sys.executable, "-P", "-m", module, *arguments]

    def _start(self, slot: _Slot) -> None:
        if self.spare_is_ready and self._spare is not None and self._spare.tell({"become": slot.worker}):
            slot.process, self._spare = self._spare, None
            slot.process.started_s = time.monotonic()
            log.warning("%s: the spare, process %d, takes its place", slot.worker, slot.process.pid)
            return
        stage = stage_of(slot.worker)
        command = self._command(f"velod.workers.{stage}", slot.worker)
        if slot.is_further and not slot.restarts:
            command = [*self._command("velod.runtime.spare", slot.worker), "--stages", stage]
        slot.process = ChildProcess(command, self._on_line)
        log.info("%s: process %d started", slot.worker, slot.process.pid)

    def _bury(self, slot: _Slot) -> None:
        """Note why a worker died, and when to start it again."""
        assert slot.process is not None
        slot.died_s = time.monotonic()
        slot.last_death = slot.process.why()
        lived_s = slot.died_s - slot.process.started_s
        slot.quick_deaths = 1 if lived_s > STEADY_S else slot.quick_deaths + 1
        delay_s = restart_delay_s(slot.quick_deaths)
        slot.due_s = slot.died_s + delay_s
        slot.restarts += 1
        log.warning(
            "%s (process %d) died after %.1f s: %s; restarting %s",
            slot.worker,
            slot.process.pid,
            lived_s,
            slot.last_death,
            f"in {delay_s:.1f} s" if delay_s else "now",
        )
        slot.process.close()
        slot.process = None

    def _keep_a_spare(self) -> None:
        if not self._wants_spare:
            return
        if self._spare is not None and self._spare.exit_code() is not None:
            log.warning("the spare died: %s; going on without one", self._spare.why())
            self._spare.close()
            self._spare, self._wants_spare = None, False
        elif self._spare is None and self.is_up(self._stages):
            command = [*self._command("velod.runtime.spare", ""), "--stages", ",".join(self._stages)]
            self._spare, self._spare_is_known = ChildProcess(command, self._on_line), False
        elif self.spare_is_ready and not self._spare_is_known:
            self._spare_is_known = True
            log.info("the spare is ready")

    def _counters(self) -> dict[str, int]:
        return {f"restarts.{s.worker}": s.restarts for s in self._slots.values() if s.restarts}

    def _alarms(self) -> dict[str, str]:
        now_s = time.monotonic()
        return {
            s.worker: f"died {now_s - s.died_s:.0f} s ago: {s.last_death}"
            for s in self._slots.values()
            if s.restarts and now_s - s.died_s < REMEMBERED_S
        }


def restart_delay_s(quick_deaths: int) -> float:
    """None after a first death, then twice as long each time, up to a limit."""
    return 0.0 if quick_deaths <= 1 else min(FIRST_DELAY_S * 2.0 ** (quick_deaths - 2), LAST_DELAY_S)
