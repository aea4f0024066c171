"""Equal arguments give equal recordings: also to the process that compiles the simulator, and to those after it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numba.core.dispatcher
import pytest

from velod.sim import cast, events, shade, texture
from velod.sim.kernels import SAME_BITS

RENDER = """
import hashlib
import numpy as np
from velod.sim import sequence
from velod.sim.render import Renderer
from velod.sim.texture import make_texture
boxes = sequence("boxes-4")
eye = Renderer(boxes.scene, make_texture(boxes.texture), boxes.calibration.left)
motion = boxes.trajectory.at(np.array([0.0, 0.1]))
digest = hashlib.sha256()
for R_WB, p_WB in zip(motion.R_WB, motion.p_WB):
    eye.render(R_WB, p_WB, np.array([[0, 180, 0, 240]]))
    digest.update(eye.depth.tobytes() + eye.intensity.tobytes())
print(digest.hexdigest())
"""


def test_views_are_the_same_to_the_bit_whether_compiled_just_now_or_before(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-P", "-c", RENDER]
    fresh, cached = (subprocess.check_output(command, env=environment, text=True) for _ in range(2))
    assert any(tmp_path.rglob("*.nbc"))
    assert fresh == cached


@pytest.mark.parametrize("module", [events, cast, shade, texture])
def test_no_kernel_may_round_as_llvm_sees_fit(module: object) -> None:
    kernels = [k for k in vars(module).values() if isinstance(k, numba.core.dispatcher.Dispatcher)]
    assert kernels
    for kernel in kernels:
        freedom = kernel.targetoptions.get("fastmath", set())
        assert freedom is not True and set(freedom) <= SAME_BITS, kernel
