"""The inner loops of the front end are vector instructions: a look at what LLVM emitted, on processors with AVX2."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numba
import pytest
from llvmlite import binding

from velod.config import Settings
from velod.depth import zncc
from velod.events import sae, selection
from velod.flow import kernel
from velod.ingest import stream
from velod.runtime.warmup import plain_calibration, warm_up

# Inner functions are compiled into these.
PACKED = {
    "the sums of plane fits": ("flow", kernel.fit_flows, r"vfmadd\w+pd\s.*[yz]mm"),
    "correlation": ("depth", zncc._match, r"vfmadd\w+ps\s.*[yz]mm"),
    "the scores' normalisation": ("depth", zncc._match, r"vsqrtpd\s.*[yz]mm"),
    "the tests for symmetric neighbourhoods": ("ingest", selection._mark_passed, r"vsubps\s.*[yz]mm"),
    "the encoding of ages": ("ingest", sae._encode_ages, r"vpmul(lq|udq)\s.*[yz]mm"),
    "the checks of a packet": ("ingest", stream._check, r"vpcmp\w+\s.*[yz]mm"),
}


def assembly(function: Any) -> str:
    """Of a fresh compilation for the types it has met: what comes from a cache cannot be looked at."""
    options = {k: v for k, v in function.targetoptions.items() if k not in ("nopython", "cache")}
    fresh: Any = numba.njit(**options)(function.py_func)
    for signature in function.signatures:
        fresh.compile(signature)
    return "\n".join(fresh.inspect_asm().values())


@pytest.fixture(scope="module")
def warm() -> Callable[[str], None]:
    done: set[str] = set()

    def once(stage: str) -> None:
        if stage not in done:
            warm_up(stage, Settings(), plain_calibration())
            done.add(stage)

    return once


@pytest.mark.skipif(not binding.get_host_cpu_features().get("avx2"), reason="for processors with AVX2")
@pytest.mark.parametrize("what", PACKED)
def test_the_inner_loop_is_packed(what: str, warm: Callable[[str], None]) -> None:
    stage, function, instruction = PACKED[what]
    warm(stage)
    assert function.signatures
    assert re.search(instruction, assembly(function)) is not None, f"no {instruction}"
