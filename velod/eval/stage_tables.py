"""Tables of stage errors: one line for each recording, and for each group of its events."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from velod.eval.stage_errors import DepthErrors, FlowErrors, StageErrors

Table = list[list[str]]

_FLOW = ("flows", "bias %", "± se", "spread %", "> 50 %: %", "sigmas", "std", "> 4: %", "late ms", "± se")
_DEPTH = (
    *("depths", "bias px", "± se", "MAD px", "> 2 px: %", "Z bias %", "Z spread %"),
    *("sigmas", "std", "> 4: %"),
)
FLOW_TITLE = "Normal flow against the truth"
DEPTH_TITLE = "Disparity and depth against the truth"


def overview_tables(found: Mapping[str, StageErrors | None]) -> dict[str, Table]:
    """Title -> table, with a line for each recording; dashes where nothing is known."""
    share = (
        "selected",
        "judged %",
        "beside a jump %",
        "with flow %",
        "with depth %",
        "where possible %",
        "refined %",
    )
    shares, flow, depth = ([["recording", *head]] for head in (share, _FLOW, ("which", *_DEPTH)))
    for name, e in found.items():
        if e is None:
            for table in (shares, flow, depth):
                table.append([name, *("-" for _ in table[0][1:])])
            continue
        of = (e.judged, e.beside_jump, e.with_flow, e.with_depth, e.with_depth_where_possible, e.refined)
        shares.append([name, str(e.selected), *(_percent(v, 1) for v in of)])
        flow.append([name, *_flow_cells(e.flow)])
        for which, errors in (("all", e.depth), ("refined", e.refined_depth), ("block", e.block_depth)):
            depth.append([name, which, *_depth_cells(errors)])
    return {"Selected events, and what became of them": shares, FLOW_TITLE: flow, DEPTH_TITLE: depth}


def group_tables(found: Mapping[str, StageErrors | None]) -> dict[str, Table]:
    """As ``overview_tables``, with a line for each group."""
    tables: dict[str, Table] = {}
    for name, e in found.items():
        for what, groups in ({} if e is None else e.groups).items():
            flow = tables.setdefault(f"{FLOW_TITLE}, by {what}", [["recording", what, *_FLOW]])
            depth = tables.setdefault(f"{DEPTH_TITLE}, by {what}", [["recording", what, *_DEPTH]])
            flow += [[name, g.label, *_flow_cells(g.flow)] for g in groups]
            depth += [[name, g.label, *_depth_cells(g.depth)] for g in groups]
    return tables


def as_json(errors: StageErrors) -> dict[str, Any]:
    """All numbers by their names in StageErrors; what is not known is None."""
    known: dict[str, Any] = _without_nan(asdict(errors))
    return known


def _flow_cells(e: FlowErrors) -> list[str]:
    return [
        str(e.n),
        *(_percent(v, d) for v, d in ((e.bias, 2), (e.bias_se, 2), (e.spread, 2), (e.outliers, 2))),
        *(_number(v, 2) for v in (e.sigmas, e.std)),
        _percent(e.beyond_4, 2),
        *(_number(1e3 * v, 2) for v in (e.late_s, e.late_se_s)),
    ]


def _depth_cells(e: DepthErrors) -> list[str]:
    return [
        str(e.n),
        *(_number(v, 3) for v in (e.bias_px, e.bias_se_px, e.mad_px)),
        *(_percent(v, 2) for v in (e.wrong, e.z_bias, e.z_spread)),
        *(_number(v, 2) for v in (e.sigmas, e.std)),
        _percent(e.beyond_4, 2),
    ]


def _percent(share: float, decimals: int) -> str:
    return _number(100.0 * share, decimals)


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if math.isfinite(value) else "-"


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_without_nan(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
