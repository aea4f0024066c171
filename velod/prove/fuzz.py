"""``velod prove fuzz``: bad inputs by the million for every decoder, from a fuzzer that sees what they reach."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

SHARES = {"messages": 0.96, "keys": 0.02, "settings": 0.01, "calibration": 0.01}
"""Of all inputs. Messages come from anybody, many a second; the others are the user's own files, and slow to read."""
_LONGEST = 4096


@dataclass(frozen=True, slots=True)
class Fuzzed:
    """What a decoder took."""

    decoder: str
    inputs: int
    edges: int  # of its code that inputs reached
    seconds: float
    peak_mib: int  # resident memory of the whole process
    crash: str  # what it raised; empty: nothing but its own error


class FuzzError(RuntimeError):
    """The fuzzer cannot run here; one line."""


def fuzz(decoder: str, runs: int, seed: int, corpus: str | None = None) -> Fuzzed:
    """Give ``runs`` inputs to a decoder, in a process of its own. The same seed gives the same inputs.

    ``corpus``: a folder to begin from, and to keep inputs that reached something new in. Raises FuzzError.
    """
    if find_spec("atheris") is None:
        raise FuzzError("the fuzzer needs the package atheris (Linux): pip install 'velod[fuzz]'")
    with TemporaryDirectory(prefix="velod-fuzz-") as folder:
        kept = Path(corpus) / decoder if corpus is not None else Path(folder) / "corpus"
        kept.mkdir(parents=True, exist_ok=True)
        options = [f"-runs={runs}", f"-seed={seed}", f"-max_len={_LONGEST}", "-print_final_stats=1", "-verbosity=1"]
        # A shell between: the peak of a process's memory begins with that of the one which starts it.
        command = ["sh", "-c", '"$@"; exit $?', "sh"]
        command += [sys.executable, "-P", "-m", "velod.prove.fuzz_target", decoder, str(kept), *options]
        start_s = time.monotonic()
        done = subprocess.run(
            [*command, f"-artifact_prefix={folder}/"], capture_output=True, text=True, errors="replace", check=False
        )
        return _result(decoder, done.stdout + done.stderr, done.returncode, time.monotonic() - start_s)


def _result(decoder: str, said: str, code: int, seconds: float) -> Fuzzed:
    def number(pattern: str) -> int:
        found = re.findall(pattern, said)
        return int(found[-1]) if found else 0

    crash = ""
    if code != 0:
        telling = [line for line in said.splitlines() if re.search(r"Error|ERROR|Exception|assert", line)]
        crash = f"exit code {code}: " + " | ".join(telling[-3:] or said.splitlines()[-3:])
    inputs = number(r"stat::number_of_executed_units:\s+(\d+)")
    return Fuzzed(decoder, inputs, number(r"cov: (\d+)"), seconds, number(r"stat::peak_rss_mb:\s+(\d+)"), crash)
