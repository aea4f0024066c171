"""``velod eval --stages``: normal flow and depth of recordings against the truth, without the optimizer."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from velod.cli.config import calibration_of, settings_of
from velod.cli.files import write_json
from velod.cli.line import with_progress
from velod.config import Settings
from velod.eval.front_end import FrontEnd
from velod.eval.scene_truth import DepthImages, SceneTruthError, TrueDepth
from velod.eval.stage_errors import StageErrors, stage_errors
from velod.eval.stage_tables import as_json, group_tables, overview_tables
from velod.eval.table import text_table
from velod.geometry.rectify import rectify
from velod.io import Recording, open_recording, read_depth


def judge_stages(config: str | None, files: Sequence[str], json: str | None, calibration: str | None = None) -> int:
    """Print the errors of each recording's flow and depth. Raises ValueError where there is no truth to judge by."""
    settings = settings_of(config, calibration)
    found: dict[str, StageErrors] = {}  # by the recording's name
    for file in files:
        recording = open_recording(file, calibration=calibration_of(settings))
        true_depth = true_depth_of(recording)
        if true_depth is None:
            raise ValueError(
                f"{file}: holds no truth to judge flow and depth by: motion with positions, depth images"
            )
        found[recording.path.stem] = _errors(settings, recording, true_depth)
    out = sys.stderr if json == "-" else sys.stdout
    for title, lines in {**overview_tables(found), **group_tables(found)}.items():
        print(f"{title}\n{text_table(lines)}\n", file=out)
    for name, errors in found.items():
        print(f"{name}: truth by {errors.how}", file=out)
    if json is not None:
        rows = [{"name": name, **as_json(errors)} for name, errors in found.items()]
        write_json(json, rows if len(rows) > 1 else rows[0])
    return 0


def true_depth_of(recording: Recording) -> TrueDepth | None:
    """By ray casting where the simulator knows the recording, else by its depth images; None where neither is had."""
    from velod.sim.true_depth import CastDepth, recipe_of

    if recording.truth is None or not recording.path.is_file():
        return None
    depth, rectification = read_depth(recording.path), rectify(recording.calibration)
    recipe = recipe_of(recording.calibration, recording.truth, depth)
    if recipe is not None:
        return CastDepth(recipe, rectification)
    try:
        return None if depth is None else DepthImages(depth, recording.truth, recording.calibration, rectification)
    except SceneTruthError:
        return None


def stages_of(settings: Settings, recording: Recording, front_end: FrontEnd, true_depth: TrueDepth) -> StageErrors:
    """Errors of what a front end made of a recording with that truth."""
    assert recording.truth is not None, "there is a true depth"
    return stage_errors(
        recording.calibration, recording.truth, true_depth, settings.depth,
        front_end.selected, front_end.flows, front_end.depths,
    )  # fmt: skip


def _errors(settings: Settings, recording: Recording, true_depth: TrueDepth) -> StageErrors:
    from velod.runtime.offline import run_front_end

    front_end = FrontEnd()
    packets = with_progress(recording.packets(), recording.t_start_ns, recording.t_end_ns)
    run_front_end(settings, recording.calibration, packets, front_end.note)
    return stages_of(settings, recording, front_end, true_depth)
