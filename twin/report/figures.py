"""The figures of a report, as SVG to stand inside HTML. Colours and marks are those of `fantwin view`."""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from fantwin.schemas.channels import CHANNELS, Channel, axis_range
from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.twin.report.content import Content, FanContent
from fantwin.twin.report.steady_states import StaticCurve
from fantwin.twin.report.timeline import broken_at, kept_samples
from fantwin.twin.runs import Array

MEASURED, TWIN, BAND, OUTSIDE, COMMAND, GAP = "#454545", "#006e30", "#a6dfb9", "#d62020", "#3b5ba5", "#ebebeb"
STYLE: dict[Any, Any] = {
    "svg.hashsalt": "fantwin",
    "svg.fonttype": "path",
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.handlelength": 1.4,
}
WIDE_IN, NARROW_IN, SMALL_IN = (11.5, 5.4), (4.2, 6.0), (4.0, 2.9)
BESIDE_IN = 0.95
"""height of the panel of each column beside command and speed, inches"""
WIDE_COLUMNS, NARROW_COLUMNS = 500, 200
MOST_TICKS = 5
AROUND_PEAK_SAMPLES = 300
MOST_MARKS = 500
CONTOURS = 8
KNOWN_POINTS = 61
HISTOGRAM_SIGMAS = 5.0
HISTOGRAM_BINS = 50
LONG_DECIMALS = re.compile(r"(\.\d\d)\d+")
"""Decimals of coordinates: a hundredth of a point is invisible, and more digits would double the page."""
LINE = {"lw": 0.5, "color": MEASURED, "solid_joinstyle": "round"}


def over_time(content: Content, fan: FanContent, *, narrow: bool) -> str:
    """Measured speed on free run and band, the error in its band, the command, and the other measured columns."""
    width_in, height_in = NARROW_IN if narrow else WIDE_IN
    beside = [column for column in CHANNELS if np.isfinite(fan.auxiliary.get(column.name, np.nan)).any()]
    with _figure((width_in, height_in + BESIDE_IN * len(beside))) as figure:
        shares = [2.4, 1.5, 0.8] + [0.8] * len(beside)
        panels: list[Axes] = figure.subplots(len(shares), 1, sharex=True, height_ratios=shares).tolist()
        speed, error, command, *others = panels
        columns = NARROW_COLUMNS if narrow else WIDE_COLUMNS
        _draw_over_time(content, fan, (speed, error, command), columns)
        for axes, column in zip(others, beside, strict=True):
            _draw_beside(content, axes, column, fan.auxiliary[column.name], columns)
        line = content.timeline
        for axes in panels:
            for gap in line.gaps:
                axes.axvspan(gap.start_s, gap.stop_s, color=GAP, lw=0, zorder=0.5)
            for start_s, _ in line.recordings[1:]:
                axes.axvline(start_s, color="#888888", lw=0.8, ls=(0, (4, 3)))
        if len(line.recordings) > 1 and not narrow:
            for start_s, name in line.recordings:
                speed.text(start_s, 1.01, f" {name}", transform=speed.get_xaxis_transform(), size=7.5, color="#555555")
        panels[-1].set_xlabel("time in the recording (s)" if line.keeps_the_clock else "measured time (s)")
        speed.legend(loc="lower left", bbox_to_anchor=(0, 1.04), ncols=2 if narrow else 4, borderaxespad=0.0)
        figure.align_ylabels()
        return _svg(
            figure, f"fan{fan.number}-time-{'narrow' if narrow else 'wide'}", "Speed, error and command over time"
        )


def around_the_largest_error(content: Content, fan: FanContent) -> str:
    """The same, enlarged around the largest error."""
    line, each = content.timeline, content.unit.rad_s
    errors = np.where(np.isfinite(fan.error_rad_s), np.abs(fan.error_rad_s), -1.0)
    peak = int(np.argmax(errors))
    piece = int(np.searchsorted(line.starts, peak, side="right")) - 1
    first = max(int(line.starts[piece]), peak - AROUND_PEAK_SAMPLES)
    end = int(line.starts[piece + 1]) if piece + 1 < len(line.starts) else len(line.t_s)
    part = slice(first, min(end, peak + AROUND_PEAK_SAMPLES))
    t_s, twin, half = line.t_s[part], fan.predicted_rad_s[part] / each, 2.0 * fan.sigma_rad_s / each
    with _small_figure("time (s)", f"speed ({content.unit.name})") as (figure, axes):
        axes.fill_between(t_s, twin - half, twin + half, color=BAND, lw=0, label="twin ± 2σ")
        axes.plot(t_s, fan.measured_rad_s[part] / each, **{**LINE, "lw": 0.8}, label="measured")
        axes.plot(t_s, twin, color=TWIN, lw=1.4, label="free run")
        axes.plot(line.t_s[peak], fan.measured_rad_s[peak] / each, "o", color=OUTSIDE, ms=4, label="largest error")
        _legend_above(axes, 2)
        return _svg(figure, f"fan{fan.number}-peak", "Measured speed and free run around the largest error")


def histogram(content: Content, fan: FanContent) -> str:
    """The errors against the normal curve of the declared sigma; errors beyond the axis are counted at its ends."""
    sigma = fan.sigma_rad_s / content.unit.rad_s
    error = fan.error_rad_s[np.isfinite(fan.error_rad_s)] / content.unit.rad_s
    reach = HISTOGRAM_SIGMAS * max(sigma, float(np.sqrt(np.mean(error**2))) if error.size else 0.0)
    unit = content.unit.name
    with _small_figure(f"measured minus free run ({unit})", f"share per {unit}") as (figure, axes):
        axes.axvspan(-2.0 * sigma, 2.0 * sigma, color=BAND, lw=0, alpha=0.6, label="± 2σ of the card")
        if error.size and reach > 0.0:
            edges = np.linspace(-reach, reach, HISTOGRAM_BINS + 1).tolist()
            axes.hist(np.clip(error, -reach, reach), edges, density=True, color="#8a8a8a", label="errors")
        if sigma > 0.0:
            x = np.linspace(-reach, reach, 201)
            normal = np.exp(-0.5 * (x / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi))
            axes.plot(x, normal, color=TWIN, lw=1.4, label="normal, σ of the card")
        axes.set_xlim(-reach or -1.0, reach or 1.0)
        _legend_above(axes, 2)
        return _svg(figure, f"fan{fan.number}-histogram", "Histogram of the errors with the normal curve")


def autocorrelation(fan: FanContent) -> str:
    """Of the error, with the bound that white noise keeps at 95 % of the lags."""
    its = fan.residual
    with _small_figure("lag (s)", "autocorrelation") as (figure, axes):
        _draw_correlation(axes, its.lags_s, its.autocorrelation, its.bound_95, "bound of white noise, 95 %")
        axes.set_xlim(0.0, its.lags_s[-1])
        return _svg(figure, f"fan{fan.number}-autocorrelation", "Autocorrelation of the error with its bound")


def cross_correlation(fan: FanContent) -> str:
    """Of the error with the command, with the bound that unrelated signals keep at 95 % of the lags."""
    its = fan.residual
    with _small_figure("lag of the error behind the command (s)", "cross-correlation") as (figure, axes):
        bound = "bound of unrelated signals, 95 %"
        _draw_correlation(axes, its.cross_lags_s, its.cross_correlation, its.cross_bound_95, bound)
        axes.axvline(0.0, color="#888888", lw=0.6)
        axes.set_xlim(its.cross_lags_s[0], its.cross_lags_s[-1])
        return _svg(figure, f"fan{fan.number}-cross", "Cross-correlation of the error with the command, with its bound")


def static_curve(content: Content, fan: FanContent, curve: StaticCurve) -> str:
    """Steady speeds over the command: the twin's, and the measured ones."""
    each = content.unit.rad_s
    with _small_figure(_command_label(content), f"speed ({content.unit.name})") as (figure, axes):
        axes.plot(curve.twin[:, 0], curve.twin[:, 1] / each, color=TWIN, lw=1.4, label="twin, settled")
        if len(curve.measured):
            command, speed = curve.measured.T
            axes.plot(command, speed / each, "o", ms=3.5, mfc="none", color=MEASURED, label="measured, settled")
        _legend_above(axes, 2)
        return _svg(figure, f"fan{fan.number}-static", "Steady speed over command")


def what_is_known(content: Content, fan: FanContent, uncertainty: ModelUncertainty) -> str:
    """How far the twin itself may be wrong over speed and command, and where the recordings were."""
    each = content.unit.rad_s
    commands = _around(content.card.command_range, fan.raised_command)
    speeds_rad_s = _around(content.card.speed_range_rad_s, fan.measured_rad_s)
    speeds, std = speeds_rad_s / each, uncertainty.over(speeds_rad_s, commands) / each
    kept = slice(None, None, max(1, len(fan.command) // MOST_MARKS))
    with _small_figure(_command_label(content), f"speed ({content.unit.name})") as (figure, axes):
        filled = axes.contourf(commands, speeds, std, levels=CONTOURS, cmap="Greens", vmin=0.0)
        axes.plot(
            fan.raised_command[kept], fan.measured_rad_s[kept] / each, ".", ms=1.5, color=COMMAND, label="measured"
        )
        figure.colorbar(filled, ax=axes, label=f"standard deviation ({content.unit.name})")
        sigma = fan.sigma_rad_s / each
        if std.min() < sigma < std.max():
            axes.contour(commands, speeds, std, levels=[sigma], colors=OUTSIDE, linewidths=1.0)
            axes.plot([], [], color=OUTSIDE, lw=1.0, label="as large as σ")
        if content.card.command_range[0] >= 0.0:
            axes.set_xlim(left=0.0)
        if content.card.speed_range_rad_s[0] >= 0.0:
            axes.set_ylim(bottom=0.0)
        axes.grid(visible=False)
        _legend_above(axes, 2)
        return _svg(figure, f"fan{fan.number}-known", "How far the twin may be wrong over speed and command")


def _around(trained: tuple[float, float], measured: Array) -> Array:
    """Points over what the twin was trained on and a quarter of its width beyond, and over what was measured."""
    low, high = trained
    margin = 0.25 * (high - low)
    lowest, highest = np.nanmin(measured, initial=low - margin), np.nanmax(measured, initial=high + margin)
    return np.linspace(lowest, highest, KNOWN_POINTS)


def error_over_speed(content: Content, fan: FanContent) -> str:
    """Mean and standard deviation of the error over the twin's speed: over the range of the twin."""
    each, unit = content.unit.rad_s, content.unit.name
    half = 2.0 * fan.sigma_rad_s / each
    with _small_figure(f"speed of the free run ({unit})", f"error ({unit})") as (figure, axes):
        axes.axhspan(-half, half, color=BAND, lw=0, alpha=0.6, label="± 2σ of the card")
        axes.axhline(0.0, color="#888888", lw=0.6)
        middle, mean, deviation = (
            [getattr(part, name) / each for part in fan.by_speed]
            for name in ("middle_rad_s", "mean_rad_s", "std_rad_s")
        )
        reach = [2.0 * value for value in deviation]
        axes.errorbar(middle, mean, reach, fmt="o", ms=3, lw=0.8, capsize=2, color=MEASURED, label="mean ± 2 std")
        _legend_above(axes, 2)
        return _svg(figure, f"fan{fan.number}-speed", "Mean and standard deviation of the error over the speed")


def _draw_over_time(content: Content, fan: FanContent, panels: tuple[Axes, Axes, Axes], columns: int) -> None:
    speed, error, command = panels
    line, each = content.timeline, content.unit.rad_s
    half = 2.0 * fan.sigma_rad_s / each
    error_drawn = np.where(np.isfinite(fan.error_rad_s), fan.error_rad_s, np.nan)
    kept = kept_samples(line.t_s, (fan.measured_rad_s, fan.predicted_rad_s, error_drawn, fan.command), columns)
    t_s, given = broken_at(line.starts, kept, line.t_s, fan.command)
    speeds = (fan.measured_rad_s / each, fan.predicted_rad_s / each, error_drawn / each)
    measured, predicted, off = broken_at(line.starts, kept, *speeds)
    outside = np.abs(off) > half
    speed.fill_between(t_s, predicted - half, predicted + half, color=BAND, lw=0, label="twin ± 2σ")
    speed.plot(t_s, measured, **LINE, label="measured")
    speed.plot(t_s, predicted, color=TWIN, lw=1.1, label="free run of the twin")
    speed.set_ylabel(f"speed ({content.unit.name})")
    error.axhspan(-half, half, color=BAND, lw=0, alpha=0.6)
    error.plot(t_s, off, **LINE)
    error.plot(*_strokes(t_s[outside], np.sign(off[outside]) * half, off[outside]), color=OUTSIDE, lw=0.8)
    speed.plot([], [], color=OUTSIDE, label="error outside the band")
    error.set_ylabel(f"error ({content.unit.name})")
    command.step(t_s, given, where="post", color=COMMAND, lw=0.8)
    command.set_ylabel(_command_label(content, "\n"))
    command.set_xlim(line.t_s[0], line.t_s[-1])


def _draw_beside(content: Content, axes: Axes, column: Channel, values: Array, columns: int) -> None:
    """Draw a column beside command and speed, on an axis on which noise looks small."""
    line = content.timeline
    kept = kept_samples(line.t_s, (values,), columns)
    axes.plot(*broken_at(line.starts, kept, line.t_s, values), **{**LINE, "color": COMMAND})
    axes.set_ylim(axis_range(float(np.nanmin(values)), float(np.nanmax(values))))
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.set_ylabel(f"{column.title.replace(' ', chr(10))}\n({column.unit})")


def _strokes(x: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Vertical strokes as one line with breaks: a page of thousands of marks would be slow."""
    broken = np.full(len(x), np.nan)
    return np.column_stack((x, x, broken)).ravel(), np.column_stack((low, high, broken)).ravel()


def _draw_correlation(axes: Axes, lags_s: Array, values: Array, bound: float, named: str) -> None:
    if np.isfinite(bound):
        axes.axhspan(-bound, bound, color=BAND, lw=0, alpha=0.6, label=named)
    axes.axhline(0.0, color="#888888", lw=0.6)
    axes.plot(lags_s, values, color=MEASURED, lw=0.9)
    largest = np.nanmax(np.abs(values), initial=0.0) if np.isfinite(values).any() else 0.0
    reach = min(1.1 * max(float(largest), bound if np.isfinite(bound) else 0.0, 0.1), 1.05)
    axes.set_ylim(-reach, reach)
    if np.isfinite(bound):
        _legend_above(axes, 1)
    if not np.isfinite(values).any():
        axes.text(0.5, 0.6, "undefined", transform=axes.transAxes, ha="center", color="#666666")


def _command_label(content: Content, between: str = " ") -> str:
    unit = content.card.command_unit
    return f"command{between}({unit})" if unit else "command"


def _legend_above(axes: Axes, columns: int) -> None:
    """Outside the axes, where it covers nothing."""
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.01), ncols=columns, borderaxespad=0.0, columnspacing=1.2)


@contextmanager
def _figure(size_in: tuple[float, float]) -> Iterator[Figure]:
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size_in, layout="constrained")
        FigureCanvasSVG(figure)
        yield figure


@contextmanager
def _small_figure(along: str, up: str) -> Iterator[tuple[Figure, Axes]]:
    """With labels along x and up y, and so few ticks along x that those of five digits and a sign stay apart."""
    with _figure(SMALL_IN) as figure:
        axes = figure.subplots()
        axes.set_xlabel(along)
        axes.set_ylabel(up)
        axes.locator_params(axis="x", nbins=MOST_TICKS)
        yield figure, axes


def _svg(figure: Figure, name: str, described: str) -> str:
    """The figure as an svg element whose ids begin with its name, so that several can stand on one page."""
    drawn = io.StringIO()
    figure.savefig(drawn, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = drawn.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", svg)
    svg = re.sub(r' (?:d|x|y)="[^"]*"', lambda found: LONG_DECIMALS.sub(r"\1", found[0]), svg)
    return svg.replace("<svg ", f'<svg role="img" aria-label="{described}" ', 1)
