"""bands.png: the fans of a tray beside their healthy twins, from a recording.

One panel per fan shows measured speed, prediction, the band of two standard deviations, samples outside it as red dots,
and red zones above and below the band while an alarm was active. Smaller panels below it show supply voltage, current
and temperature, if they were measured. A lane shows the states and, if known, the true fault.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.dates import format_utc, has_date
from fantwin.pipeline.recordings.left_out import how_to_score
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.site.trace import Trace, state_changes, trace_of
from fantwin.schemas.channels import CHANNELS, Channel, axis_range
from fantwin.schemas.messages import Array, Score
from fantwin.schemas.units import NS_PER_S, SpeedUnit

MAX_PANELS = 12
PANEL_HEIGHT_IN, BESIDE_HEIGHT_IN, LANE_HEIGHT_IN, WIDTH_IN = 2.3, 0.8, 0.2, 12.0
BETWEEN_IN, HEADER_IN, FOOT_IN = 0.5, 1.25, 0.6

MEASURED, TWIN, BAND, ZONE, OUTSIDE, FAULT = "#454545", "#006e30", "#8fd9a8", "#f4a3a3", "#d62020", "#4a4a8a"
BESIDE = "#3b5ba5"
STATE_COLORS = {
    "normal": "#57b97a",
    "suspect": "#f2b400",
    "alarm": "#d62020",
    "returning": "#ee8a4a",
    "stopped": "#5d6b7c",
    "starting": "#3fb0b8",
}
UNKNOWN_COLOR = "#a9a9a9"


@dataclass(frozen=True)
class Fault:
    """A true fault of a simulated fan."""

    kind: str
    fan: int
    start_ns: int
    stop_ns: int


def plot_recording(
    recordings: Sequence[Path],
    output: Path,
    *,
    tray: str | None = None,
    fans: Sequence[int] | None = None,
    speed_unit: SpeedUnit | None = None,
    truth: Path | None = None,
) -> tuple[list[int], str, list[str]]:
    """Plot one tray of a recording. Returns the fans that were drawn, also in words, and what could not be read, a line
    each.

    Args:
        recordings: a recording, or its parts in any order.
        output: the picture; its suffix chooses the format.
        tray: required if there are several.
        fans: counted from 0; by default those with an alarm and one without.
        speed_unit: unit of the axis; by default the display unit of the recording.
        truth: the truth file of a simulated tray, with `faults[]` of `kind, fan, start_ns, stop_ns`.

    Raises:
        UserError: no scores, no such tray or fan, or a truth file that cannot be read.
    """
    trace, damage = read_trace(recordings, tray, speed_unit)
    faults = read_faults(truth) if truth is not None else ()
    drawn = plot_bands(trace, output, fans=fans, faults=faults)
    return drawn, trace.names.labels(drawn), damage


def read_trace(recordings: Sequence[Path], tray: str | None, speed_unit: SpeedUnit | None) -> tuple[Trace, list[str]]:
    """The scores of one tray, in order of time, and a line for each file that could not be read in full.

    Raises:
        UserError: there are no scores, or several trays and none is chosen.
    """
    scores: dict[str, list[Score]] = {}
    damage: list[str] = []
    for path in recordings:
        reading = read_recording(path, topics=("score",))
        for envelope in reading:
            assert isinstance(envelope.message, Score)
            if len(envelope.message.t_ns):
                scores.setdefault(envelope.message.header.tray, []).append(envelope.message)
        damage += [reading.damage] if reading.damage else []
    where = ", ".join(str(path) for path in recordings)
    if not scores:
        raise UserError(f"{where}: holds no scores to plot; {how_to_score(recordings)}")
    if tray is None:
        if len(scores) > 1:
            raise UserError(f"{where}: there are several trays; choose one with --tray: {', '.join(sorted(scores))}")
        (tray,) = scores
    if tray not in scores:
        raise UserError(f"{where}: holds no tray called {tray!r}; there are {', '.join(sorted(scores))}")
    chosen = sorted(scores[tray], key=lambda score: int(score.t_ns[0]))
    if len({score.fans for score in chosen}) > 1:
        raise UserError(f"{where}: {tray} changes its number of fans; plot the parts one by one")
    about = read_metadata(recordings[0])
    displayed: SpeedUnit = "rpm" if about.speed_unit(tray) == "rpm" else "rad/s"
    return trace_of(tray, chosen, speed_unit or displayed, names=about.names(tray)), damage


def read_faults(path: Path) -> list[Fault]:
    """The faults in the truth file of a simulated tray.

    Raises:
        UserError: the file is missing or invalid.
    """
    try:
        faults = json.loads(path.read_text(encoding="utf-8"))["faults"]
        return [Fault(str(f["kind"]), int(f["fan"]), int(f["start_ns"]), int(f["stop_ns"])) for f in faults]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: not a truth file ({error}); `fantwin simulate` writes one") from error


def plot_bands(
    trace: Trace, output: Path, *, fans: Sequence[int] | None = None, faults: Iterable[Fault] = ()
) -> list[int]:
    """Draw a trace and return the fans that were drawn; see `plot_recording`.

    Raises:
        UserError: the tray does not have a fan, or the format cannot be written.
    """
    shown = _chosen_fans(trace, fans)
    with mpl.rc_context({"font.size": 9.5, "axes.spines.top": False, "axes.spines.right": False}):
        figure = _figure(trace, shown, list(faults))
        try:
            figure.savefig(output, dpi=130)
        except (OSError, ValueError) as error:
            raise UserError(f"{output}: cannot write the plot: {error}") from error
    return shown


def _chosen_fans(trace: Trace, fans: Sequence[int] | None) -> list[int]:
    if fans is not None:
        for fan in fans:
            if not 0 <= fan < trace.fans:
                raise UserError(f"{trace.tray} has no fan {fan}: it has fans 0 to {trace.fans - 1}")
        return list(fans)
    alarmed = trace.in_alarm.any(axis=0)
    healthy = np.flatnonzero(~alarmed)[:1].tolist()
    return sorted(np.flatnonzero(alarmed)[:MAX_PANELS].tolist() + healthy)


def _figure(trace: Trace, fans: Sequence[int], faults: Sequence[Fault]) -> Figure:
    lanes_in = LANE_HEIGHT_IN * (2 if faults else 1)
    beside = [each for each in CHANNELS if _is_measured(trace, each, fans)]
    heights_in = [PANEL_HEIGHT_IN, *[BESIDE_HEIGHT_IN] * len(beside), lanes_in]
    block_in = sum(heights_in)
    height = HEADER_IN + FOOT_IN + len(fans) * (block_in + BETWEEN_IN) - BETWEEN_IN
    figure = Figure(figsize=(WIDTH_IN, height))
    FigureCanvasAgg(figure)
    _draw_header(figure, trace, fans, with_truth=bool(faults))
    outer = figure.add_gridspec(
        len(fans),
        1,
        hspace=BETWEEN_IN / block_in,
        left=0.085,
        right=0.985,
        top=1 - HEADER_IN / height,
        bottom=FOOT_IN / height,
    )
    for row, fan in enumerate(fans):
        inner = outer[row].subgridspec(len(heights_in), 1, height_ratios=heights_in, hspace=0.12 if beside else 0.06)
        mine = [fault for fault in faults if fault.fan == fan]
        panel = figure.add_subplot(inner[0])
        _draw_panel(panel, trace, fan, mine)
        for number, column in enumerate(beside, 1):
            _draw_beside(figure.add_subplot(inner[number], sharex=panel), trace, fan, column)
        lanes = figure.add_subplot(inner[len(beside) + 1], sharex=panel)
        _draw_lanes(lanes, trace, fan, mine, with_truth=bool(faults))
        if row == len(fans) - 1:
            start_ns = int(trace.t_ns[0])
            since = format_utc(start_ns) if has_date(start_ns) else "the first sample shown"
            lanes.set_xlabel(f"time since {since} (s)")
        else:
            lanes.tick_params(axis="x", length=0, labelbottom=False)
    return figure


def _is_measured(trace: Trace, column: Channel, fans: Sequence[int]) -> bool:
    values = trace.auxiliary.get(column.name)
    return values is not None and bool(np.isfinite(values[:, fans]).any())


def _draw_header(figure: Figure, trace: Trace, fans: Sequence[int], *, with_truth: bool) -> None:
    """Draw the title, and below it a legend of series and one of states, outside the panels."""
    height = figure.get_figheight()
    title = f"{trace.tray}: fan speed beside the healthy twin"
    figure.suptitle(title, x=0.085, ha="left", y=1 - 0.12 / height, va="top", size=14)
    for row, handles in enumerate((_series_handles(with_truth), _state_handles(trace, fans))):
        figure.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=(0.08, 1 - (0.38 + 0.26 * row) / height),
            ncols=len(handles),
            frameon=False,
            columnspacing=1.4,
            handlelength=1.6,
            borderaxespad=0.2,
        )


def _draw_panel(axes: Axes, trace: Trace, fan: int, faults: Sequence[Fault]) -> None:
    t_s = _seconds(trace, trace.t_ns)
    columns = np.stack([trace.measured[:, fan], trace.predicted[:, fan], trace.half_width[:, fan]], axis=1)
    alarm, outside = trace.in_alarm[:, fan], trace.outside[:, fan]
    gaps = _gaps(trace.t_ns)
    drawn_t_s, drawn = np.insert(t_s, gaps, t_s[gaps]), np.insert(columns, gaps, np.nan, axis=0)
    measured, predicted, half = drawn.T
    low, high = predicted - half, predicted + half
    bottom, top = _limits(measured, low, high)
    red = {"where": np.insert(alarm, gaps, False).tolist(), "color": ZONE, "alpha": 0.6, "lw": 0, "zorder": 1}
    axes.fill_between(drawn_t_s, high, top, **red)
    axes.fill_between(drawn_t_s, bottom, low, **red)
    axes.fill_between(drawn_t_s, low, high, color=BAND, lw=0, zorder=2)
    axes.plot(drawn_t_s, measured, color=MEASURED, lw=0.5, zorder=3)
    axes.plot(drawn_t_s, predicted, color=TWIN, lw=1.6, zorder=5)
    axes.plot(t_s[outside], columns[outside, 0], ".", color=OUTSIDE, ms=2.6, zorder=4)
    for fault in faults:
        for edge in _seconds(trace, np.array([fault.start_ns, fault.stop_ns])):
            axes.axvline(edge, color=FAULT, lw=1.0, ls=(0, (4, 3)), zorder=6)
    axes.set_ylim(bottom, top)
    axes.set_xlim(t_s[0], t_s[-1])
    axes.grid(axis="y", color="#e6e6e6", lw=0.6, zorder=0)
    axes.tick_params(axis="x", length=0, labelbottom=False)
    axes.set_ylabel(f"speed ({trace.speed_unit})")
    axes.set_title(_title(trace, fan, faults), loc="left", size=10.5)


def _draw_beside(axes: Axes, trace: Trace, fan: int, column: Channel) -> None:
    """Draw a column that was measured beside command and speed of the fan."""
    gaps, values = _gaps(trace.t_ns), trace.auxiliary[column.name][:, fan]
    t_s = _seconds(trace, trace.t_ns)
    axes.plot(np.insert(t_s, gaps, t_s[gaps]), np.insert(values, gaps, np.nan), color=BESIDE, lw=0.7)
    if np.isfinite(values).any():
        axes.set_ylim(axis_range(float(np.nanmin(values)), float(np.nanmax(values))))
    axes.locator_params(axis="y", nbins=3)
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.grid(axis="y", color="#e6e6e6", lw=0.6, zorder=0)
    axes.tick_params(axis="x", length=0, labelbottom=False)
    axes.set_ylabel(f"{column.title.split()[0]}\n({column.unit})", size=8.5)


def _draw_lanes(axes: Axes, trace: Trace, fan: int, faults: Sequence[Fault], *, with_truth: bool) -> None:
    changes_ns, names = state_changes(trace, fan, None)
    edges = np.append(_seconds(trace, changes_ns), _seconds(trace, trace.t_ns[-1:]))
    bars = list(zip(edges[:-1], np.diff(edges), strict=True))
    axes.broken_barh(bars, (0, 0.9), facecolors=[_state_color(name) for name in names], lw=0)
    if with_truth:
        spans = [_seconds(trace, np.array([fault.start_ns, fault.stop_ns])) for fault in faults]
        axes.broken_barh([(start, stop - start) for start, stop in spans], (1, 0.9), facecolors=FAULT, lw=0)
    axes.set_yticks([0.45, 1.45] if with_truth else [0.45], ["state", "true fault"] if with_truth else ["state"])
    axes.set_ylim(2 if with_truth else 1, 0)
    axes.tick_params(axis="y", length=0)
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)


def _title(trace: Trace, fan: int, faults: Sequence[Fault]) -> str:
    """The title of a panel: the fan, its faults and its alarms."""
    parts = [trace.names.label(fan)]
    in_alarm = trace.in_alarm[:, fan]
    raised = trace.t_ns[in_alarm & ~np.concatenate(([False], in_alarm[:-1]))]
    if not len(raised):
        parts.append("no alarm")
    for fault in faults:
        text = f"{fault.kind.replace('_', ' ').replace('-', ' ')} at {_seconds(trace, np.array(fault.start_ns)):.1f} s"
        first = next((t for t in raised.tolist() if fault.start_ns <= t <= fault.stop_ns), None)
        parts.append(text + (f", alarm {(first - fault.start_ns) / NS_PER_S:.2f} s later" if first else ", no alarm"))
    if not faults and len(raised):
        more = f" and {len(raised) - 4} more" if len(raised) > 4 else ""
        parts.append("alarm at " + ", ".join(f"{_seconds(trace, t):.1f} s" for t in raised[:4]) + more)
    return "   ".join(parts)


def _limits(measured: Array, low: Array, high: Array) -> tuple[float, float]:
    """Limits of the axis: everything drawn, with a margin."""
    values = np.concatenate([measured, low, high])
    values = values[np.isfinite(values)]
    bottom, top = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    margin = 0.08 * (top - bottom) or 1.0
    return bottom - margin, top + margin


def _gaps(t_ns: Array) -> Array:
    """Index of the first sample after each gap in time. No line is drawn across a gap."""
    steps = np.diff(t_ns)
    return np.flatnonzero(steps > 2.5 * np.median(steps)) + 1 if len(steps) else np.zeros(0, np.int64)


def _seconds(trace: Trace, t_ns: Any) -> Any:
    return (t_ns - trace.t_ns[0]) / NS_PER_S


def _state_color(name: str) -> str:
    return STATE_COLORS.get(name, UNKNOWN_COLOR)


def _series_handles(with_truth: bool) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=MEASURED, lw=1.2, label="measured"),
        Line2D([], [], color=TWIN, lw=1.8, label="twin"),
        Patch(color=BAND, lw=0, label="twin ± 2σ"),
        Line2D([], [], color=OUTSIDE, marker=".", ls="", label="outside the band (1 in 20 when healthy)"),
        Patch(color=ZONE, alpha=0.6, lw=0, label="alarm active"),
    ]
    return [*handles, Patch(color=FAULT, lw=0, label="true fault")] if with_truth else handles


def _state_handles(trace: Trace, fans: Sequence[int]) -> list[Patch]:
    seen = {name for fan in fans for name in state_changes(trace, fan, None)[1]}
    handles = [Patch(color=color, lw=0, label=name) for name, color in STATE_COLORS.items() if name in seen]
    if any(name.startswith("unknown") for name in seen):
        handles.append(Patch(color=UNKNOWN_COLOR, lw=0, label="unknown: not scored"))
    handles[0].set_label(f"state: {handles[0].get_label()}")
    return handles
