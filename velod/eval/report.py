"""The report: one HTML page that holds everything, and its pictures as files beside it."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from velod.eval import pictures
from velod.eval.compare import Case
from velod.eval.paper import PAPER, TABLE_IV_MS
from velod.eval.pictures import RelativeErrors
from velod.eval.plots import figure_class, velocity_figure
from velod.eval.table import Row
from velod.io.model import EventSource

Table = Sequence[Sequence[str]]

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 1250px; margin: 2em auto; padding: 0 1em }
h1 { font-size: 1.5em } h2 { font-size: 1.2em; margin-top: 2em; border-bottom: 1px solid #ccc }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums }
th, td { padding: 2px 9px; text-align: right; border-bottom: 1px solid #e4e4e4 }
th:first-child, td:first-child { text-align: left } th { background: #f4f4f4 }
.wide { overflow-x: auto } figure { margin: 1em 0 } img { max-width: 100% } figcaption { color: #555 }
"""


@dataclass(frozen=True, slots=True)
class StageTimes:
    """Mean host time per batch, ms."""

    preprocessing_ms: float
    flow_ms: float
    depth_ms: float
    back_end_ms: float


@dataclass(frozen=True, slots=True)
class Section:
    """What a report shows of one recording, drawn."""

    name: str
    pictures: dict[str, tuple[bytes, str]]  # kind -> PNG, caption
    relative: RelativeErrors
    motion: list[str]  # its line beside Table I
    times: StageTimes


def draw_section(row: Row, case: Case, left: EventSource, times: StageTimes) -> Section:
    """Draw a recording, with its first IMU noise. Raises PlotError without matplotlib."""
    first = {method: runs[0] for method, runs in row.judgement.items()}
    errors = {method: judged.errors(case.truth) for method, judged in first.items()}
    figures = {"methods": (pictures.error_over_time(row.name, errors), "Absolute velocity error over time (Fig. 6).")}
    if first["velod"].ever_valid:
        valid = [v for v in first["velod"].velocities if v.valid]
        figures["velocity"] = (
            velocity_figure(valid, case.truth, row.name),
            "Velocity in the body frame with 3-sigma bands, and the truth.",
        )
    figures["track"] = (
        pictures.tracks(row.name, {m: j.track for m, j in first.items() if j.track is not None}),
        "Dead reckoning seen from above (Fig. 8): one integration of the velocity, attitude by the gyroscope, from "
        "the true place at the first valid velocity. What leaves the picture is cut off.",
    )
    figures["events"] = (
        pictures.front_end(row.name, case, left),
        "Events in the middle of the recording, with normal flow and with depth.",
    )
    return Section(
        row.name,
        {kind: (_png(figure), text) for kind, (figure, text) in figures.items()},
        (row.name, {method: relative for method, (_, _, relative) in errors.items()}),
        _motion(row, case),
        times,
    )


class Report:
    """Takes the sections of one recording after the other; ``finish`` writes the page.

    Raises PlotError without matplotlib, OSError where ``directory`` cannot be written.
    """

    def __init__(self, directory: str | Path, command: str) -> None:
        figure_class()  # say so now, not after an hour
        self._directory = Path(directory)
        self._directory.mkdir(parents=True, exist_ok=True)
        self._command = command
        self._sections: list[Section] = []

    def add(self, section: Section) -> None:
        """Put a section behind the others."""
        self._sections.append(section)

    def finish(self, tables: Mapping[str, Table], notes: Sequence[str]) -> Path:
        """Write ``report.html`` and the pictures beside it; returns the page's path."""
        boxes = _png(pictures.relative_errors([section.relative for section in self._sections]))
        parts = [f"<p><code>{html.escape(self._command)}</code></p>"]
        parts += [f"<h2>{html.escape(title)}</h2>\n{_html_table(lines)}" for title, lines in tables.items()]
        parts.append("<ul>" + "".join(f"<li>{html.escape(note)}</li>" for note in notes) + "</ul>")
        head = ["sequence", "s", "mean |v| m/s", "mean |w| rad/s", "left events, M/s", "Table I: |v|", "|w|"]
        motions = [section.motion for section in self._sections]
        parts.append(f"<h2>Motion and events, beside Table I</h2>\n{_html_table([head, *motions])}")
        parts.append(f"<h2>Time per batch, beside Table IV (ms)</h2>\n{_html_table(self._table_iv())}")
        caption = "Relative velocity error (Fig. 7), first IMU noise: box 25-75 %, line the median, whiskers 5-95 %."
        parts.append(self._image("rve", boxes, caption))
        for section in self._sections:
            parts.append(f'<h2 id="{html.escape(section.name)}">{html.escape(section.name)}</h2>')
            parts += [
                self._image(f"{section.name}_{kind}", png, text) for kind, (png, text) in section.pictures.items()
            ]
        path = self._directory / "report.html"
        path.write_text(
            '<!doctype html>\n<html lang="en"><meta charset="utf-8"><title>velod: evaluation</title>\n'
            f"<style>{_STYLE}</style>\n<h1>velod: evaluation</h1>\n" + "\n".join(parts) + "\n</html>\n",
            encoding="utf-8",
        )
        return path

    def _table_iv(self) -> list[list[str]]:
        head = ["", "preprocessing, with reading the file", "flow", "depth", "flow and depth", "back end", "overall"]
        lines = [head]
        for section in self._sections:
            t = section.times
            both = t.flow_ms + t.depth_ms
            values = (t.preprocessing_ms, t.flow_ms, t.depth_ms, both, t.back_end_ms)
            overall = t.preprocessing_ms + both + t.back_end_ms
            lines.append([section.name, *(f"{v:.1f}" for v in (*values, overall))])
        paper = TABLE_IV_MS
        lines.append(
            ["paper", f"{paper['preprocessing']:.0f}", "", ""]
            + [f"{paper[k]:.0f}" for k in ("flow and depth", "back end", "overall")]
        )
        return lines

    def _image(self, name: str, png: bytes, caption: str) -> str:
        (self._directory / f"{name}.png").write_bytes(png)
        data, text = base64.b64encode(png).decode("ascii"), html.escape(caption)
        return (
            f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'
        )


def _motion(row: Row, case: Case) -> list[str]:
    speed, rate = (float(np.linalg.norm(a, axis=1).mean()) for a in (case.truth.v_B, case.truth.omega_B))
    paper = PAPER.get(row.name)
    beside = ["", ""] if paper is None else [f"{paper.speed_mps:.2f}", f"{paper.rate_rad_s:.2f}"]
    events = sum(batch.n_events for batch in case.own.selected) / row.seconds * 1e-6
    return [row.name, f"{row.seconds:g}", f"{speed:.2f}", f"{rate:.2f}", f"{events:.2f}", *beside]


def _html_table(lines: Table) -> str:
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in lines[0])
    body = "\n".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in line) + "</tr>" for line in lines[1:]
    )
    return f'<div class="wide"><table><tr>{head}</tr>\n{body}</table></div>'


def _png(figure: Any) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110)
    return out.getvalue()
