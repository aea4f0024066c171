"""Pictures of a run: velocity with its 3-sigma bands against the truth, and the error over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from velod.eval.metrics import truth_at
from velod.io.model import Truth
from velod.types import NS_PER_S, Velocity

_AXES = ("x", "y", "z")


class PlotError(ValueError):
    """Nothing can be drawn; the text says why."""


def plot_run(velocities: Sequence[Velocity], truth: Truth | None, directory: str | Path, name: str) -> list[Path]:
    """Write ``<name>_velocity.png`` and, with a truth, ``<name>_error.png``; returns their paths.

    Raises PlotError without matplotlib or without a valid velocity.
    """
    shown = [v for v in velocities if v.valid]
    if not shown:
        raise PlotError(f"{name}: nothing to plot: no valid velocity")
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    figures = {"velocity": velocity_figure(shown, truth, name)}
    if truth is not None:
        figures["error"] = _error_figure(shown, truth, name)
    written = []
    for kind, figure in figures.items():
        path = directory / f"{name}_{kind}.png"
        figure.savefig(path, dpi=120)
        written.append(path)
    return written


def figure_class() -> Any:
    """matplotlib's Figure. Raises PlotError where it is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise PlotError("plots need matplotlib: pip install 'velod[plot]'") from None
    return Figure


def velocity_figure(shown: Sequence[Velocity], truth: Truth | None, name: str) -> Any:
    """The components of valid velocities with their 3-sigma bands, and the truth."""
    figure = figure_class()(figsize=(10, 7), layout="constrained")
    figure.suptitle(name)
    t_s = np.array([v.t_ns for v in shown]) / NS_PER_S
    v_B = np.array([v.v_B for v in shown])
    band = 3.0 * np.sqrt(np.array([np.diag(v.cov) for v in shown]))
    for i, axes in enumerate(figure.subplots(3, 1, sharex=True)):
        axes.fill_between(t_s, v_B[:, i] - band[:, i], v_B[:, i] + band[:, i], alpha=0.25, label="3 sigma")
        axes.plot(t_s, v_B[:, i], lw=1.0, label="velod")
        if truth is not None:
            axes.plot(truth.t_ns / NS_PER_S, truth.v_B[:, i], "k--", lw=0.8, label="truth")
        axes.set_ylabel(f"v_{_AXES[i]} [m/s]")
        axes.grid(alpha=0.3)
    figure.axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False)
    figure.axes[-1].set_xlabel("sensor time [s]")
    return figure


def _error_figure(shown: Sequence[Velocity], truth: Truth, name: str) -> Any:
    figure = figure_class()(figsize=(10, 3.5), layout="constrained")
    figure.suptitle(name)
    inside = [v for v in shown if truth.t_ns[0] <= v.t_ns <= truth.t_ns[-1]]
    t_ns = np.array([v.t_ns for v in inside], dtype=np.int64)
    v_B = np.array([v.v_B for v in inside]).reshape(-1, 3)
    axes = figure.subplots()
    axes.plot(t_ns / NS_PER_S, np.linalg.norm(truth_at(truth, t_ns) - v_B, axis=1), lw=1.0)
    axes.set_xlabel("sensor time [s]")
    axes.set_ylabel("|v_gt - v_est| [m/s]")
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    return figure
