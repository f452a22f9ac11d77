"""The layout of a view in Rerun: for each tray a tab with plots, state lanes and alarm log, and a tab for the stages.

A fleet has other tabs, see `rerun_fleet`. Measured with Rerun 0.41; see docs/how-to/viewing.md. Only the modules whose
names begin with `rerun_` import rerun.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.archetypes import TextLogColumns
from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

from pipeline.viewing.trace import state_names
from schemas.auxiliary import AuxiliaryColumn
from schemas.units import SpeedUnit

TIMELINE = "time"
STAGES_PATH = "stages"
FLEET_LOG = "fleet/log"
SHOWN = "shown"
FAN_PARTS = ("speed", "deviation", "outside", "not_scored")
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
    """The fans of a tray that are shown, counted from 0, and their unit of speed.

    places: in the view of a fleet, the numbers of the plots that have shown each fan. auxiliary: the columns beside
    command and speed that are drawn.
    """

    name: str
    fans: Sequence[int]
    speed_unit: SpeedUnit
    places: Mapping[int, Sequence[int]] = field(default_factory=dict[int, Sequence[int]])
    auxiliary: Sequence[AuxiliaryColumn] = ()

    def roots(self, fan: int) -> list[str]:
        """The entities below which the fan is drawn."""
        return [place_root(place, self.name) for place in self.places.get(fan, ())] or [self.name]

    def lanes(self, fans: Sequence[int]) -> list[str]:
        """The entities of the state lanes of some fans."""
        places = sorted({place for fan in fans for place in self.places.get(fan, ())})
        return [place_lane(place) for place in places] or [state_path(self.name, fan) for fan in fans]

    @property
    def log(self) -> str:
        """The entity of the log."""
        return FLEET_LOG if self.places else log_path(self.name)


def fan_path(root: str, fan: int, part: str) -> str:
    """Entity of one fan below the root of its tray, which is the tray's name but in a fleet.

    `part` is `speed` (measured, twin), `deviation`, `outside` or `not_scored`.
    """
    return f"{root}/fan_{fan}/{part}"


def state_path(tray: str, fan: int) -> str:
    """Entity of a fan's state lane."""
    return f"{tray}/state/fan_{fan}"


def auxiliary_path(tray: str, column: str, fan: int | None = None) -> str:
    """Entity of what a fan's source measures beside command and speed; without a fan, that of all fans."""
    return f"{tray}/{column}" if fan is None else f"{tray}/{column}/fan_{fan}"


def log_path(tray: str) -> str:
    """Entity of a tray's log."""
    return f"{tray}/log"


def place_root(place: int, tray: str) -> str:
    """In a fleet, the root of a tray's fans in plot number `place`."""
    return f"{SHOWN}/plot_{place}/{tray}"


def place_in(root: str) -> int | None:
    """The number of the plot whose root begins so; None: it is no root of a plot."""
    shown, _, name = root.partition("/")
    return int(name.removeprefix("plot_")) if shown == SHOWN and name.startswith("plot_") else None


def place_lane(place: int) -> str:
    """In a fleet, the entity of the state lane of plot number `place`."""
    return f"{SHOWN}/state/plot_{place}"


def place_auxiliary(place: int, column: str) -> str:
    """In a fleet, the entity of what is measured beside command and speed of the fan in plot number `place`."""
    return f"{SHOWN}/{column}/plot_{place}"


def speed_style(unit: SpeedUnit, width: float, name: str = "") -> rr.Measurements:
    """Style of the series of a fan's `speed`: measured, twin with band, and the lowest and highest ends of the band,
    which are not seen: an axis fits the lines, not the bands around them.

    Width 0 shows the band only. `name` is that of the fan, where the plot has another title.
    """
    prefix = f"{name} " if name else ""
    twin = f"{prefix}twin ± 2σ ({unit})"
    return rr.Measurements.from_fields(
        names=[f"{prefix}measured ({unit})", twin, twin, twin],
        colors=[VIOLET, GREEN, GREEN, GREEN],
        widths=[width, width, 0.0, 0.0],
    )


def log_styles(recording: rr.RecordingStream, tray: TrayLayout) -> None:
    """Log the static names, colours and widths of every series of a tray."""
    for fan in tray.fans:
        log_fan_styles(recording, tray.name, fan, speed_style(tray.speed_unit, LINE_WIDTH))
        log_state_styles(recording, state_path(tray.name, fan), state_names())


def log_fan_styles(recording: rr.RecordingStream, root: str, fan: int, speed: rr.Measurements) -> None:
    """Log the static names, colours and widths of the series of a fan; `speed`: see `speed_style`."""
    deviation = rr.Measurements.from_fields(names="area in alarm", colors=RED, widths=0.0)
    recording.log(fan_path(root, fan, "speed"), speed, static=True)
    recording.log(fan_path(root, fan, "deviation"), deviation, static=True)
    outside = rr.SeriesPoints(names="dots outside band", colors=RED, marker_sizes=2.0)
    recording.log(fan_path(root, fan, "outside"), outside, static=True)
    not_scored = rr.SeriesLines(names="not scored", colors=GREY, widths=LINE_WIDTH)
    recording.log(fan_path(root, fan, "not_scored"), not_scored, static=True)


def log_state_styles(recording: rr.RecordingStream, path: str, names: Sequence[str]) -> None:
    """Log the static colours of a lane that shows these states."""
    colors = [STATE_COLORS.get(name, UNKNOWN_COLOR) for name in names]
    recording.log(path, rr.StateConfiguration(values=list(names), colors=colors), static=True)


def blueprint(tabs: Sequence[rrb.Container | rrb.View], *, for_picture: bool = False) -> rrb.Blueprint:
    """The whole layout of some tabs; it follows the newest data. A picture has no panels and no tab for the stages."""
    if not for_picture:
        tabs = [*tabs, rrb.TextDocumentView(origin=f"/{STAGES_PATH}", name="stages")]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0) if len(tabs) > 1 else tabs[0],
        rrb.TopPanel(state="hidden" if for_picture else "expanded"),
        rrb.TimePanel(timeline=TIMELINE, play_state="following", state="hidden" if for_picture else "collapsed"),
        auto_views=False,
        collapse_panels=True,
    )


def tray_tab(tray: TrayLayout, window_s: float) -> rrb.Container:
    """The tab of a tray, with a window of `window_s` seconds."""
    starts = range(0, len(tray.fans), FANS_ON_A_PAGE)
    pages = [_page(tray, tray.fans[start : start + FANS_ON_A_PAGE], window_s) for start in starts]
    return rrb.Tabs(*pages, active_tab=0, name=tray.name) if len(pages) > 1 else pages[0]


def _page(tray: TrayLayout, fans: Sequence[int], window_s: float) -> rrb.Container:
    """Up to `FANS_ON_A_PAGE` plots, their state lanes and the tray's log."""
    name = tray.name if len(fans) == len(tray.fans) else f"{tray.name} / fans {fans[0]} to {fans[-1]}"
    columns = 1 if len(fans) <= 2 else 2 if len(fans) <= 4 else 4
    axis = rolling(window_s, MARGIN_FOR_LEGEND[columns])
    lanes = rrb.StateTimelineView(
        origin="/" if tray.places else f"/{tray.name}",
        contents=[f"/{path}" for path in tray.lanes(fans)],
        name=f"{tray.name} / state of each fan",
        time_view=rolling(window_s, 0.0),
    )
    lane_share = (1.7 + len(fans)) / 24
    plots: rrb.Container = rrb.Grid(*(_fan_view(tray, fan, axis) for fan in fans), grid_columns=columns)
    if tray.auxiliary:
        measured = [_auxiliary_view(tray, column, fans, window_s) for column in tray.auxiliary]
        plots = rrb.Vertical(plots, rrb.Horizontal(*measured), row_shares=[3, 1])
    return rrb.Vertical(
        plots,
        rrb.Horizontal(
            lanes, log_view(tray.log, "alarm log" if tray.places else f"{tray.name} / alarm log"), column_shares=[3, 2]
        ),
        row_shares=[1 - lane_share, lane_share],
        name=name,
    )


def _auxiliary_view(
    tray: TrayLayout, column: AuxiliaryColumn, fans: Sequence[int], window_s: float
) -> rrb.TimeSeriesView:
    """What is measured of some fans beside command and speed: one line for each."""
    return rrb.TimeSeriesView(
        origin=f"/{auxiliary_path(tray.name, column.name)}",
        contents=[f"/{auxiliary_path(tray.name, column.name, fan)}" for fan in fans],
        name=f"{tray.name} / {column.title} ({column.unit})",
        axis_x=rolling(window_s, 0.0),
    )


def _fan_view(tray: TrayLayout, fan: int, axis: rrb.TimeAxis) -> rrb.TimeSeriesView:
    fill, lines = speed_style(tray.speed_unit, 0.0), speed_style(tray.speed_unit, LINE_WIDTH)
    roots = tray.roots(fan)
    return rrb.TimeSeriesView(
        origin=f"/{roots[0]}/fan_{fan}",
        contents=[f"/{fan_path(root, fan, part)}" for root in roots for part in FAN_PARTS],
        name=f"{tray.name} / fan {fan} speed ({tray.speed_unit})",
        axis_x=axis,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
        # A single band is faint. Drawing the same data twice makes it solid and sends no more bytes.
        overrides={fan_path(root, fan, "speed"): [fill.visualizer(), lines.visualizer()] for root in roots},
    )


def log_view(path: str, name: str) -> rrb.TextLogView:
    """The view of a log."""
    return rrb.TextLogView(
        origin=f"/{path}",
        name=name,
        columns=TextLogColumns(
            timeline_columns=[TimelineColumn(TIMELINE, visible=False)],  # too narrow to read: lines begin with it
            text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")],
        ),
    )


def rolling(window_s: float, margin: float) -> rrb.TimeAxis:
    """A window that follows the cursor; the share `margin` of it stays empty at the right."""
    cursor = rrb.TimeRangeBoundary.cursor_relative
    return rrb.TimeAxis(view_range=rr.TimeRange(start=cursor(seconds=-window_s), end=cursor(seconds=margin * window_s)))
