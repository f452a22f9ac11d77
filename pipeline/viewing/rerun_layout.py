"""The layout of a view in Rerun: for each tray a tab with plots, state lanes and alarm log, and a tab for the stages.

Measured with Rerun 0.41; see docs/how-to/viewing.md. Only this module, `rerun_sink` and `rerun_picture` import rerun.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.archetypes import TextLogColumns
from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

from pipeline.viewing.trace import state_names
from schemas.units import SpeedUnit

TIMELINE = "time"
STAGES_PATH = "stages"
FANS_ON_A_PAGE = 8  # Rerun draws a page of a hundred plots only seven times a second
MARGIN_FOR_LEGEND = {1: 0.12, 2: 0.25, 4: 0.45}  # columns of plots -> share of the window kept free at the right

LINE_WIDTH = 1.2
# Lines are legible on the dark and on the light background of Rerun.
VIOLET = (160, 100, 250)
GREEN = (25, 160, 75)
RED = (240, 50, 50)
GREY = (135, 135, 135)
STATE_COLORS = {
    "normal": (38, 150, 76),
    "suspect": (250, 178, 0),
    "alarm": (224, 36, 36),
    "returning": (232, 120, 60),
    "commissioning": (90, 140, 200),
    "stopped": (70, 82, 104),
    "starting": (40, 160, 170),
}
UNKNOWN_COLOR = (110, 110, 110)


@dataclass(frozen=True)
class TrayLayout:
    """The fans of a tray that are shown, counted from 0, and their unit of speed."""

    name: str
    fans: Sequence[int]
    speed_unit: SpeedUnit


def fan_path(tray: str, fan: int, part: str) -> str:
    """Entity of one fan: `part` is `speed` (measured, twin), `deviation`, `outside` or `not_scored`."""
    return f"{tray}/fan_{fan}/{part}"


def state_path(tray: str, fan: int) -> str:
    """Entity of a fan's state lane."""
    return f"{tray}/state/fan_{fan}"


def log_path(tray: str) -> str:
    """Entity of a tray's log."""
    return f"{tray}/log"


def speed_style(unit: SpeedUnit, width: float) -> rr.Measurements:
    """Style of the series of a fan's `speed`: measured, twin with band, and the lowest and highest ends of the band,
    which are not seen: an axis fits the lines, not the bands around them. Width 0 shows the band only."""
    twin = f"twin ± 2σ ({unit})"
    return rr.Measurements.from_fields(
        names=[f"measured ({unit})", twin, twin, twin],
        colors=[VIOLET, GREEN, GREEN, GREEN],
        widths=[width, width, 0.0, 0.0],
    )


def log_styles(recording: rr.RecordingStream, tray: TrayLayout) -> None:
    """Log the static names, colours and widths of every series of a tray."""
    for fan in tray.fans:
        deviation = rr.Measurements.from_fields(names="area in alarm", colors=RED, widths=0.0)
        recording.log(fan_path(tray.name, fan, "speed"), speed_style(tray.speed_unit, LINE_WIDTH), static=True)
        recording.log(fan_path(tray.name, fan, "deviation"), deviation, static=True)
        recording.log(
            fan_path(tray.name, fan, "outside"),
            rr.SeriesPoints(names="dots outside band", colors=RED, marker_sizes=2.0),
            static=True,
        )
        recording.log(
            fan_path(tray.name, fan, "not_scored"),
            rr.SeriesLines(names="not scored", colors=GREY, widths=LINE_WIDTH),
            static=True,
        )
        names = state_names()
        recording.log(
            state_path(tray.name, fan),
            rr.StateConfiguration(values=names, colors=[STATE_COLORS.get(name, UNKNOWN_COLOR) for name in names]),
            static=True,
        )


def blueprint(trays: Sequence[TrayLayout], window_s: float, *, for_picture: bool = False) -> rrb.Blueprint:
    """The whole layout, with a window of `window_s` seconds that follows the newest data. A picture has no panels."""
    tabs: list[rrb.Container | rrb.View] = [_tray_tab(tray, window_s) for tray in trays]
    if not for_picture:
        tabs.append(rrb.TextDocumentView(origin=f"/{STAGES_PATH}", name="stages"))
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0) if len(tabs) > 1 else tabs[0],
        rrb.TopPanel(state="hidden" if for_picture else "expanded"),
        rrb.TimePanel(timeline=TIMELINE, play_state="following", state="hidden" if for_picture else "collapsed"),
        auto_views=False,
        collapse_panels=True,
    )


def _tray_tab(tray: TrayLayout, window_s: float) -> rrb.Container:
    starts = range(0, len(tray.fans), FANS_ON_A_PAGE)
    pages = [_page(tray, tray.fans[start : start + FANS_ON_A_PAGE], window_s) for start in starts]
    return rrb.Tabs(*pages, active_tab=0, name=tray.name) if len(pages) > 1 else pages[0]


def _page(tray: TrayLayout, fans: Sequence[int], window_s: float) -> rrb.Container:
    """Up to `FANS_ON_A_PAGE` plots, their state lanes and the tray's log."""
    name = tray.name if len(fans) == len(tray.fans) else f"{tray.name} / fans {fans[0]} to {fans[-1]}"
    columns = 1 if len(fans) <= 2 else 2 if len(fans) <= 4 else 4
    axis = _rolling(window_s, MARGIN_FOR_LEGEND[columns])
    lanes = rrb.StateTimelineView(
        origin=f"/{tray.name}",
        contents=[f"/{state_path(tray.name, fan)}" for fan in fans],
        name=f"{tray.name} / state of each fan",
        time_view=_rolling(window_s, 0.0),
    )
    lane_share = (1.7 + len(fans)) / 24
    return rrb.Vertical(
        rrb.Grid(*(_fan_view(tray, fan, axis) for fan in fans), grid_columns=columns),
        rrb.Horizontal(lanes, _log_view(tray.name), column_shares=[3, 2]),
        row_shares=[1 - lane_share, lane_share],
        name=name,
    )


def _fan_view(tray: TrayLayout, fan: int, axis: rrb.TimeAxis) -> rrb.TimeSeriesView:
    speed = fan_path(tray.name, fan, "speed")
    fill, lines = speed_style(tray.speed_unit, 0.0), speed_style(tray.speed_unit, LINE_WIDTH)
    return rrb.TimeSeriesView(
        origin=f"/{tray.name}/fan_{fan}",
        contents=[f"/{fan_path(tray.name, fan, part)}" for part in ("speed", "deviation", "outside", "not_scored")],
        name=f"{tray.name} / fan {fan} speed ({tray.speed_unit})",
        axis_x=axis,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
        # A single band is faint. Drawing the same data twice makes it solid and sends no more bytes.
        overrides={speed: [fill.visualizer(), lines.visualizer()]},
    )


def _log_view(tray: str) -> rrb.TextLogView:
    return rrb.TextLogView(
        origin=f"/{log_path(tray)}",
        name=f"{tray} / alarm log",
        columns=TextLogColumns(
            timeline_columns=[TimelineColumn(TIMELINE, visible=False)],  # too narrow to read: lines begin with it
            text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")],
        ),
    )


def _rolling(window_s: float, margin: float) -> rrb.TimeAxis:
    """A window that follows the cursor; the share `margin` of it stays empty at the right."""
    cursor = rrb.TimeRangeBoundary.cursor_relative
    return rrb.TimeAxis(view_range=rr.TimeRange(start=cursor(seconds=-window_s), end=cursor(seconds=margin * window_s)))
