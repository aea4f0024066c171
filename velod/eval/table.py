"""Tables of a comparison: mean and spread over the noises of the IMU, beside the paper's numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from velod.eval.compare import METHODS, Judgement
from velod.eval.imu_alone import ImuAlone
from velod.eval.paper import PAPER
from velod.eval.stage_errors import StageErrors
from velod.eval.stage_tables import as_json as stages_as_json
from velod.eval.stage_tables import group_tables, overview_tables

NONE_VALID = "*"
REAL = "r"
_SHOWN_GROUPS = ("by distance", "by edge direction, |n_x|")


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
    imu_alone: ImuAlone | None = None  # over a longer time, and many noises
    stages: StageErrors | None = None  # of velod's front end, where the truth of it is known

    def ave(self, method: str) -> Spread:
        """AVE over the runs of a method, m/s."""
        return spread(j.metrics.ave_mps for j in self.judgement.get(method, ()))

    def rve(self, method: str) -> Spread:
        """RVE (Eq. 16) over the runs of a method, %."""
        return spread(j.metrics.rve_percent for j in self.judgement.get(method, ()))

    def drift(self, method: str) -> Spread:
        """Drift of the dead reckoning over the runs of a method, % of the distance."""
        return spread(j.track.drift_percent for j in self.judgement.get(method, ()) if j.track is not None)

    def marked(self, method: str) -> str:
        """The mark of a method of which no velocity was valid, in one run at least."""
        return "" if all(j.ever_valid for j in self.judgement.get(method, ())) else NONE_VALID


def ave_table(rows: Sequence[Row]) -> list[list[str]]:
    """AVE of every method, m/s; the first line is the head."""
    head = ["sequence", "s", *METHODS, "IMU, s", "IMU long", "paper: ours", "paper: IMU", "paper: Ben.", "in"]
    return [head, *(_ave_line(row) for row in rows)]


def rve_table(rows: Sequence[Row]) -> list[list[str]]:
    """Mean RVE of every method, %. The paper has box plots only; beside it stands its AVE over its mean speed."""
    head = ["sequence", *METHODS, "paper: AVE/speed"]
    lines = [head]
    for row in rows:
        paper = PAPER.get(row.name)
        share = "" if paper is None else f"{100.0 * paper.ours_mps / paper.speed_mps:.2f}"
        lines.append([row.name, *(row.rve(m).text() + row.marked(m) for m in METHODS), share])
    return lines


def quartile_table(rows: Sequence[Row]) -> list[list[str]]:
    """25, 50 and 75 % of the RVE, the boxes of Fig. 7, in %; means over the noises."""
    lines = [["sequence", *METHODS]]
    for row in rows:
        cells = []
        for method in METHODS:
            quartiles = zip(*(j.metrics.rve_quartiles_percent for j in row.judgement.get(method, ())), strict=True)
            means = [spread(values).mean for values in quartiles]
            cells.append(" / ".join(f"{m:.3g}" for m in means) + row.marked(method) if means else "-")
        lines.append([row.name, *cells])
    return lines


def imu_table(rows: Sequence[Row]) -> list[list[str]]:
    """AVE of the IMU alone over growing times, m/s: median, and 5 to 95 % of the noises; beside it the paper's."""
    known = [(row, row.imu_alone) for row in rows if row.imu_alone is not None]
    steps_s = sorted({s for _, alone in known for s in alone.seconds})
    head = ["sequence", "noises", *(f"{s:g} s" for s in steps_s), "paper: IMU", "noises below it at"]
    lines = [head]
    for row, alone in known:
        by_time = dict(zip(alone.seconds, alone.quantiles((0.05, 0.5, 0.95)).T, strict=True))
        cells = ["{1:.2f} ({0:.2f} - {2:.2f})".format(*by_time[s]) if s in by_time else "" for s in steps_s]
        paper, beside = PAPER.get(row.name), ["", ""]
        if paper is not None:
            below = 100.0 * float(alone.share_below(paper.imu_mps)[-1])
            beside = [
                f"{paper.imu_mps:.2f}{f' {REAL}' if paper.real else ''}",
                f"{alone.seconds[-1]:g} s: {below:.0f} %",
            ]
        lines.append([row.name, str(len(alone.ave_mps)), *cells, *beside])
    return lines


def paper_table() -> list[list[str]]:
    """Tables II and III of the paper, AVE in m/s, whatever was judged."""
    lines = [["paper's sequence", "ours", "IMU", "VINS-Fusion", "PR-VINS", "USLAM", "Benosman-NF", "Ours", "in"]]
    for name, p in PAPER.items():
        others = [f"{v:.2f}" if math.isfinite(v) else "failed" for v in p.others_mps]
        lines.append(
            [p.name, name, f"{p.imu_mps:.2f}", *others, f"{p.benosman_mps:.2f}", f"{p.ours_mps:.2f}", p.table]
        )
    return lines


def detail_table(rows: Sequence[Row]) -> list[list[str]]:
    """What else is known of velod's own estimate, and the drift of dead reckoning, % of the distance."""
    head = [
        *(
            "sequence",
            "median m/s",
            "95 % m/s",
            "RVE median %",
            "95 %",
            "valid from s",
            "valid %",
            "NEES",
            "in 1/2/3 sigma %",
        ),
        *("drift %: velod", "paper-like", "linear", "IMU"),
    ]
    lines = [head]
    for row in rows:
        own = [j.metrics for j in row.judgement["velod"]]
        shares = ((m.within_1_sigma, m.within_2_sigma, m.within_3_sigma) for m in own)
        lines.append(
            [
                row.name,
                spread(m.median_mps for m in own).text(),
                spread(m.p95_mps for m in own).text(),
                spread(m.rve_quartiles_percent[1] for m in own).text(),
                spread(m.rve_p95_percent for m in own).text(),
                spread(m.first_valid_s for m in own).text(),
                f"{100.0 * spread(m.valid_fraction for m in own).mean:.1f}",
                spread(m.nees_mean for m in own).text(),
                "/".join(f"{100.0 * s:.0f}" for s in np.mean(list(shares), axis=0)),
                *(row.drift(m).text() for m in ("velod", "paper-like", "linear", "IMU")),
            ]
        )
    return lines


def all_tables(rows: Sequence[Row]) -> dict[str, list[list[str]]]:
    """Title -> table, in the order in which they are read."""
    stages = {row.name: row.stages for row in rows}
    of_imu = {"IMU alone from a true start, AVE in m/s": imu_table(rows)} if any(r.imu_alone for r in rows) else {}
    groups = {title: lines for title, lines in group_tables(stages).items() if title.endswith(_SHOWN_GROUPS)}
    return {
        "AVE, m/s": ave_table(rows),
        "RVE (Eq. 16), %": rve_table(rows),
        "RVE: 25 / 50 / 75 % (the boxes of Fig. 7), %": quartile_table(rows),
        "velod's own estimate, and dead reckoning": detail_table(rows),
        **of_imu,
        **overview_tables(stages),
        **groups,
    }


def more_tables(rows: Sequence[Row]) -> dict[str, list[list[str]]]:
    """Those that only a report has room for."""
    groups = group_tables({row.name: row.stages for row in rows})
    return {
        **{title: lines for title, lines in groups.items() if not title.endswith(_SHOWN_GROUPS)},
        "The paper's Tables II and III, AVE in m/s": paper_table(),
    }


def notes(rows: Sequence[Row], seeds: Sequence[int]) -> list[str]:
    """What the tables do not say by themselves."""
    count = "One noise" if len(seeds) < 2 else f"Mean ± standard deviation over {len(seeds)} noises"
    lines = [
        f"{count} of the IMU (seeds: {', '.join(map(str, seeds)) or 'as recorded'}); the events are the same.",
        "Only the IMU's integration is given any truth: its initial velocity and attitude.",
        *(f"{name}: {what}." for name, what in METHODS.items() if name != "velod"),
        "Latency is that of the processes, and not measured here: velod eval FILE, without --offline.",
        *(f"{row.name}: true depth by {row.stages.how}." for row in rows if row.stages is not None),
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
    alone = row.imu_alone
    return [
        row.name,
        f"{row.seconds:g}",
        *(row.ave(m).text() + row.marked(m) for m in METHODS),
        "" if alone is None else f"{alone.seconds[-1]:g}",
        "" if alone is None else spread(alone.ave_mps[:, -1]).text(),
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
        "imu_alone": None
        if row.imu_alone is None
        else {"seconds": list(row.imu_alone.seconds), "ave_mps": row.imu_alone.ave_mps.tolist()},
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
