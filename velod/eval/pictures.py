"""Pictures that compare methods, and what the front end sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from velod.eval.compare import METHODS, Case
from velod.eval.dead_reckoning import Track
from velod.eval.plots import figure_class
from velod.io.model import NO_EVENTS, EventColumns, EventSource
from velod.types import F64, I64, NS_PER_S, DepthBatch, FlowBatch

RelativeErrors = tuple[str, Mapping[str, F64]]
"""Name of a recording, and the relative errors (%) of each method."""

_COLOURS = {
    "velod": "#0b5fa5",
    "floor": "#7a7a7a",
    "paper-like": "#e07b00",
    "linear": "#3a9a3a",
    "Benosman-NF": "#c02f2f",
    "IMU": "#8a4fbf",
}
_TRAIL_PX = 4.0
_ARROW_PX = 14.0
_ARROWS = 220
_LEAST_MPS = 1e-3  # what begins at the truth would stretch the axis without end


def error_over_time(name: str, errors: Mapping[str, tuple[I64, F64, F64]]) -> Any:
    """|v_gt - v_est| of each method over time, logarithmic."""
    figure = figure_class()(figsize=(11, 4.6), layout="constrained")
    axes = figure.subplots()
    for method in reversed([m for m in METHODS if m in errors]):  # velod on top
        t_ns, error, _ = errors[method]
        if len(error) == 0:
            continue
        width = 1.8 if method == "velod" else 1.0
        label = f"{method}: AVE {error.mean():.3g} m/s"
        axes.plot(t_ns / NS_PER_S, np.maximum(error, _LEAST_MPS), color=_COLOURS[method], lw=width, label=label)
    axes.set(yscale="log", xlabel="sensor time [s]", ylabel="|v_gt - v_est| [m/s]", title=name)
    axes.set_ylim(bottom=max(axes.get_ylim()[0], _LEAST_MPS))
    axes.grid(alpha=0.3, which="both")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), reverse=True, frameon=False)
    return figure


def relative_errors(recordings: Sequence[RelativeErrors]) -> Any:
    """Box plots of Eq. 16, one group for each recording."""
    from matplotlib.patches import Patch

    figure = figure_class()(figsize=(max(7.0, 1.6 * len(recordings) + 2.5), 5.0), layout="constrained")
    axes = figure.subplots()
    width = 0.8 / len(METHODS)
    for k, (_, relative) in enumerate(recordings):
        for i, method in enumerate(METHODS):
            values = relative.get(method, np.empty(0))
            values = values[np.isfinite(values)]
            if len(values):
                box = axes.boxplot(
                    [values],
                    positions=[k + (i - (len(METHODS) - 1) / 2) * width],
                    widths=0.85 * width,
                    whis=(5, 95),
                    showfliers=False,
                    patch_artist=True,
                    medianprops={"color": "black"},
                )
                box["boxes"][0].set_facecolor(_COLOURS[method])
    axes.set(yscale="log", ylabel="RVE [%]", xlim=(-0.5, len(recordings) - 0.5))
    axes.set_xticks(range(len(recordings)), [name for name, _ in recordings])
    axes.grid(alpha=0.3, axis="y", which="both")
    handles = [Patch(facecolor=_COLOURS[m], label=m) for m in METHODS]
    axes.legend(handles=handles, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def tracks(name: str, found: Mapping[str, Track]) -> Any:
    """Dead-reckoned paths from above, and the true one; what leaves the picture is cut off."""
    figure = figure_class()(figsize=(9, 6.2), layout="constrained")
    axes = figure.subplots()
    for method in ("Benosman-NF", "IMU", "linear", "paper-like", "velod"):
        if method in found:
            track = found[method]
            label = f"{method}: drift {track.drift_percent:.3g} %"
            axes.plot(track.p_WB[:, 0], track.p_WB[:, 1], color=_COLOURS[method], lw=1.4, label=label)
    true = max((t.true_p_WB for t in found.values()), key=len, default=np.zeros((1, 3)))
    axes.plot(true[:, 0], true[:, 1], "k--", lw=1.0, label="truth")
    axes.plot(true[0, 0], true[0, 1], "ko", ms=5, label="start")
    low, high = true[:, :2].min(axis=0), true[:, :2].max(axis=0)
    margin = 0.25 * float((high - low).max()) + 0.05
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    axes.set(xlabel="x_W [m]", ylabel="y_W [m]", title=name, aspect="equal")
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def front_end(name: str, case: Case, left: EventSource) -> Any:
    """Events of the moment in the middle of a recording with its normal flow, and with its depth."""
    figure = figure_class()(figsize=(13, 5.0), layout="constrained")
    flow_axes, depth_axes = figure.subplots(1, 2)
    batches = list(case.own.batches())
    if not batches:
        figure.suptitle(f"{name}: no batch with flow and depth")
        return figure
    flow, depth = batches[len(batches) // 2]
    trail_s, arrow_s = (_motion_time(flow, px) for px in (_TRAIL_PX, _ARROW_PX))
    events = _events_within(left, flow.t_ns - int(trail_s * NS_PER_S), flow.t_ns)
    camera = case.calibration.left
    for axes in (flow_axes, depth_axes):
        axes.set(
            xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5), aspect="equal", xticks=[], yticks=[]
        )
    flow_axes.imshow(_event_image(events, camera.width, camera.height), interpolation="nearest")
    depth_axes.imshow(0.75 + 0.25 * _event_image(events, camera.width, camera.height), interpolation="nearest")
    _draw_arrows(flow_axes, flow, arrow_s)
    _draw_depth(figure, depth_axes, flow, depth)
    figure.suptitle(f"{name}, t = {flow.t_ns / NS_PER_S:.3f} s")
    flow_axes.set_title(f"events of {1e3 * trail_s:g} ms (ON red, OFF blue), normal flow over {1e3 * arrow_s:g} ms")
    depth_axes.set_title("depth of the selected events")
    return figure


def _motion_time(flow: FlowBatch, px: float) -> float:
    """In which an edge moves by about ``px``, s, to one digit; at most 0.1."""
    speed = float(np.median(flow.speed)) if len(flow.x) else 0.0
    return float(f"{px / max(speed, 10.0 * px):.0e}")


def _draw_arrows(axes: Any, flow: FlowBatch, arrow_s: float) -> None:
    """The motion of some edges over ``arrow_s``."""
    some = slice(None, None, max(1, len(flow.x) // _ARROWS))
    d = flow.n[some] * flow.speed[some, None] * arrow_s
    axes.quiver(
        flow.x[some], flow.y[some], d[:, 0], d[:, 1],
        angles="xy", scale_units="xy", scale=1.0, color="#008a00", width=0.0025, headwidth=3.5,
    )  # fmt: skip


def _draw_depth(figure: Any, axes: Any, flow: FlowBatch, depth: DepthBatch) -> None:
    z = 1.0 / depth.inv_depth
    low, high = np.percentile(z, (2, 98)) if len(z) else (0.0, 1.0)
    dots = axes.scatter(flow.x, flow.y, c=z, s=9, cmap="turbo_r", vmin=low, vmax=high)
    figure.colorbar(dots, ax=axes, label="depth [m]", shrink=0.8)


def _event_image(events: EventColumns, width: int, height: int) -> F64:
    """(height, width, 3): red where the last event was ON, blue where it was OFF, white without."""
    image = np.ones((height, width, 3))
    image[events.y, events.x] = np.where(events.p[:, None] == 1, (0.95, 0.45, 0.40), (0.40, 0.55, 0.95))
    return image


def _events_within(left: EventSource, begin_ns: int, end_ns: int) -> EventColumns:
    """Those of [begin_ns, end_ns)."""
    parts = []
    for block in left.blocks():
        if len(block.t_ns) and block.t_ns[0] >= end_ns:
            break
        inside = (block.t_ns >= begin_ns) & (block.t_ns < end_ns)
        if inside.any():
            parts.append([column[inside] for column in (block.t_ns, block.x, block.y, block.p)])
    return EventColumns(*(np.concatenate(columns) for columns in zip(*parts, strict=True))) if parts else NO_EVENTS
