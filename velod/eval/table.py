"""Tables of a comparison: mean and spread over the noises of the IMU, beside the paper's numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from velod.eval.compare import METHODS, Judged, Judgement
from velod.eval.paper import PAPER
from velod.eval.stage_errors import StageErrors
from velod.eval.stage_tables import as_json as stages_as_json

NONE_VALID = "*"
REAL = "r"


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean of some values and their standard deviation (NaN of fewer than two)."""

    mean: float
    spread: float
    values: tuple[float, ...]

    def text(self) -> str:
        """``0.031±0.002``: three significant digits of the mean, as many decimals of the spread."""
        if not math.isfinite(self.mean):
            return "-"
        decimals = 3 if abs(self.mean) < 1.0 else 2 if abs(self.mean) < 100.0 else 0
        tail = f"±{self.spread:.{decimals}f}" if math.isfinite(self.spread) else ""
        return f"{self.mean:.{decimals}f}{tail}"


def spread(values: Iterable[float]) -> Spread:
    """Of the finite values; NaN of none."""
    known = tuple(v for v in values if math.isfinite(v))
    return Spread(
        float(np.mean(known)) if known else math.nan,
        float(np.std(known, ddof=1)) if len(known) > 1 else math.nan,
        known,
    )


@dataclass(frozen=True, slots=True)
class Row:
    """One recording in the tables."""

    name: str
    seconds: float
    judgement: Judgement
    imu_seconds: float = math.nan  # length of the longer integration of the IMU
    imu_long: tuple[Judged, ...] = ()
    stages: StageErrors | None = None  # of velod's front end, where the truth of it is known

    def ave(self, method: str) -> Spread:
        return spread(j.metrics.ave_mps for j in self.judgement.get(method, ()))

    def rve(self, method: str) -> Spread:
        return spread(j.metrics.rve_percent for j in self.judgement.get(method, ()))

    def drift(self, method: str) -> Spread:
        return spread(j.track.drift_percent for j in self.judgement.get(method, ()) if j.track is not None)

    def marked(self, method: str) -> str:
        """The mark of a method of which no velocity was valid, in one run at least."""
        return "" if all(j.ever_valid for j in self.judgement.get(method, ())) else NONE_VALID


def ave_table(rows: Sequence[Row]) -> list[list[str]]:
    """AVE of every method, m/s; the first line is the head."""
    head = ["sequence", "s", *METHODS, "IMU, s", "IMU long", "paper: ours", "paper: IMU", "paper: Ben.", "in"]
    return [head, *(_ave_line(row) for row in rows)]


def rve_table(rows: Sequence[Row]) -> list[list[str]]:
    """RVE of every method, %. The paper has it as box plots only; beside it stands its AVE over its mean speed."""
    head = ["sequence", *METHODS, "paper: AVE/speed"]
    lines = [head]
    for row in rows:
        paper = PAPER.get(row.name)
        share = "" if paper is None else f"{100.0 * paper.ours_mps / paper.speed_mps:.2f}"
        lines.append([row.name, *(row.rve(m).text() + row.marked(m) for m in METHODS), share])
    return lines


def detail_table(rows: Sequence[Row]) -> list[list[str]]:
    """What else is known of velod's own estimate, and the drift of dead reckoning, % of the distance."""
    head = [
        *("sequence", "95 % m/s", "valid from s", "valid %", "NEES", "in 1/2/3 sigma %"),
        *("drift %: velod", "paper-like", "linear", "IMU"),
    ]
    lines = [head]
    for row in rows:
        own = [j.metrics for j in row.judgement["velod"]]
        shares = ((m.within_1_sigma, m.within_2_sigma, m.within_3_sigma) for m in own)
        lines.append(
            [
                row.name,
                spread(m.p95_mps for m in own).text(),
                spread(m.first_valid_s for m in own).text(),
                f"{100.0 * spread(m.valid_fraction for m in own).mean:.1f}",
                spread(m.nees_mean for m in own).text(),
                "/".join(f"{100.0 * s:.0f}" for s in np.mean(list(shares), axis=0)),
                *(row.drift(m).text() for m in ("velod", "paper-like", "linear", "IMU")),
            ]
        )
    return lines


def notes(rows: Sequence[Row], seeds: Sequence[int]) -> list[str]:
    """What the tables do not say by themselves."""
    count = "One noise" if len(seeds) < 2 else f"Mean ± standard deviation over {len(seeds)} noises"
    lines = [
        f"{count} of the IMU (seeds: {', '.join(map(str, seeds)) or 'as recorded'}); the events are the same.",
        "Only the IMU's integration is given any truth: its initial velocity and attitude.",
        *(f"{name}: {what}." for name, what in METHODS.items() if name != "velod"),
    ]
    if any(row.marked(method) for row in rows for method in row.judgement):
        lines.append(f"{NONE_VALID} no velocity was valid in a run: all were judged.")
    if any(row.name in PAPER and PAPER[row.name].real for row in rows):
        lines.append(f"{REAL} the paper's numbers are of real recordings of that kind of motion, ours are simulated.")
    return lines


def text_table(lines: Sequence[Sequence[str]]) -> str:
    """Columns aligned: the first to the left, the others to the right."""
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    return "\n".join(
        "  ".join([line[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(line[1:], widths[1:], strict=True))])
        for line in lines
    )


def as_json(rows: Sequence[Row], seeds: Sequence[int]) -> dict[str, Any]:
    """Everything in the tables; what is not known is None."""
    return {"imu_seeds": list(seeds), "sequences": [_row_json(row) for row in rows]}


def _ave_line(row: Row) -> list[str]:
    paper = PAPER.get(row.name)
    beside = ["", "", "", ""]
    if paper is not None:
        where = paper.table + (f" {REAL}" if paper.real else "")
        beside = [f"{paper.ours_mps:.2f}", f"{paper.imu_mps:.2f}", f"{paper.benosman_mps:.2f}", where]
    long = spread(j.metrics.ave_mps for j in row.imu_long)
    return [
        row.name,
        f"{row.seconds:g}",
        *(row.ave(m).text() + row.marked(m) for m in METHODS),
        f"{row.imu_seconds:g}" if row.imu_long else "",
        long.text() if row.imu_long else "",
        *beside,
    ]


def _row_json(row: Row) -> dict[str, Any]:
    paper = PAPER.get(row.name)
    return {
        "name": row.name,
        "seconds": row.seconds,
        "methods": {
            method: {
                "ave_mps": _spread_json(row.ave(method)),
                "rve_percent": _spread_json(row.rve(method)),
                "drift_percent": _spread_json(row.drift(method)),
                "ever_valid": all(j.ever_valid for j in runs),
                "runs": [
                    j.metrics.row(drift_percent=None if j.track is None else j.track.drift_percent) for j in runs
                ],
            }
            for method, runs in row.judgement.items()
        },
        "imu_long": None
        if not row.imu_long
        else {
            "seconds": row.imu_seconds,
            "ave_mps": _spread_json(spread(j.metrics.ave_mps for j in row.imu_long)),
            "rve_percent": _spread_json(spread(j.metrics.rve_percent for j in row.imu_long)),
        },
        "stages": None if row.stages is None else stages_as_json(row.stages),
        "paper": None
        if paper is None
        else {
            "name": paper.name,
            "table": paper.table,
            "real": paper.real,
            "ave_mps": {"ours": paper.ours_mps, "imu": paper.imu_mps, "benosman_nf": paper.benosman_mps},
        },
    }


def _spread_json(s: Spread) -> dict[str, Any]:
    return {
        "mean": s.mean if math.isfinite(s.mean) else None,
        "spread": s.spread if math.isfinite(s.spread) else None,
        "values": list(s.values),
    }
