"""``velod doctor``: whether this machine, this installation and these settings are fit for velod."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict

from velod.cli.config import settings_of
from velod.cli.exit import EXIT_FAILED
from velod.cli.files import write_json
from velod.cli.place import Way, place_of
from velod.runtime import checkup
from velod.runtime.checkup import Finding

_ADVICE_INDENT = " " * 8


def doctor(config: str | None, calibration: str | None, way: Way, json_path: str | None) -> int:
    """Print a line for each thing that was looked at; 1 where one of them keeps velod from working.

    Raises ConfigError for settings that velod would not take.
    """
    out = sys.stderr if json_path == "-" else sys.stdout
    findings = []
    for finding in _look(config, calibration, way):
        print(f"{finding.state:<5} {finding.name}: {finding.found}", file=out, flush=True)
        if finding.advice:
            print(f"{_ADVICE_INDENT}-> {finding.advice}", file=out)
        findings.append(finding)
    count = {state: sum(f.state == state for f in findings) for state in ("WARN", "FAIL")}
    print(f"\n{len(findings)} checks, {count['WARN']} warnings, {count['FAIL']} failures", file=out)
    if json_path is not None:
        write_json(json_path, [asdict(finding) for finding in findings])
    return EXIT_FAILED if count["FAIL"] else 0


def _look(config: str | None, calibration: str | None, way: Way) -> Iterator[Finding]:
    settings = settings_of(config, calibration)
    place = place_of(config, way, "operator")
    yield checkup.python()
    yield from checkup.packages()
    yield checkup.kernels()
    yield checkup.processors()
    yield checkup.memory()
    yield checkup.shared_memory()
    yield checkup.clock()
    yield checkup.calibration(settings.rig.calibration, settings.depth)
    yield from checkup.certificates(place.zenoh.keys, place.rig)
    yield checkup.service(place.rig, place.zenoh, expected=bool(way.connect or settings.zenoh.connect))
