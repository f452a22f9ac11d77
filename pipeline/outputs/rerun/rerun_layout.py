"""The layout of a view in Rerun. Live views and view files have the same: it comes from here alone.

`all`: for each tray a tab with plots, state lanes, alarms and log. `alarms`: the fans that
are in alarm or were, and nothing else; of a fleet, the fans that are drawn, in both layouts. `wear`: how the speed of
each fan has changed, on a timeline of days. All plots of a layout share one time axis. Only the modules whose names
begin with `rerun_` import rerun. Measured with Rerun 0.41; see docs/how-to/viewing.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.archetypes import TextLogColumns
from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

from fantwin.pipeline.outputs.rerun.rerun_styles import (
    ALARMS_PATH,
    BALANCE,
    DAYS,
    FAN_PARTS,
    FANS_ON_A_PAGE,
    FLEET_LOG,
    LINE_WIDTH,
    SCORE,
    TIMELINE,
    auxiliary_path,
    balance_style,
    fan_path,
    judged_path,
    log_fan_styles,
    log_path,
    pages_of,
    score_style,
    speed_style,
    state_path,
    wear_path,
)
from fantwin.schemas.channels import Channel
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.units import SpeedUnit

LayoutName = Literal["all", "alarms", "wear"]
ALARMS_ON_A_PAGE = 4
MARGIN_FOR_LEGEND = {1: 0.12, 2: 0.25, 4: 0.02}
"""columns of plots -> share of the window kept free at the right; four columns leave no room for legends"""
MIN_LANE_SHARE = 0.24
"""of the height, for state lanes, alarms and log"""
LINKED = rrb.TimeAxis(link="LinkToGlobal")
_SHARED_VIEW = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc"
"""where a blueprint keeps the range of all linked time axes (`GLOBAL_VIEW_ID` of Rerun, for which it has no call)"""


@dataclass(frozen=True)
class TrayLayout:
    """The fans of a tray and what is shown of them.

    Attributes:
        fans: how many it has.
        is_of_fleet: only some fans are drawn, each apart.
        auxiliary: the columns beside command and speed that are drawn.
        alarmed: the fans that have been in alarm; of a fleet, those that are drawn.
    """

    name: str
    fans: int
    speed_unit: SpeedUnit
    is_of_fleet: bool = False
    auxiliary: Sequence[Channel] = ()
    alarmed: Sequence[int] = ()
    names: FanNames = NO_NAMES

    @property
    def judged_together(self) -> int:
        """How many fans have their torque balances, and their scores, in one entity."""
        return 1 if self.is_of_fleet else FANS_ON_A_PAGE

    @property
    def log(self) -> str:
        """The entity of the log."""
        return FLEET_LOG if self.is_of_fleet else log_path(self.name)


FanPlot = tuple[TrayLayout, int]


def log_styles(recording: rr.RecordingStream, tray: TrayLayout, fans: Sequence[int]) -> None:
    """Log the static names, colours and widths of every series of some fans."""
    for fan in fans:
        log_fan_styles(recording, tray.name, fan, tray.speed_unit, tray.names.name(fan))
    for page, of_page in enumerate(pages_of(range(tray.fans), tray.judged_together)):
        if not set(of_page).isdisjoint(fans):
            recording.log(judged_path(tray.name, BALANCE, page), balance_style(len(of_page)), static=True)
            recording.log(judged_path(tray.name, SCORE, page), score_style(len(of_page)), static=True)


def site_blueprint(name: LayoutName, trays: Sequence[TrayLayout], window_s: float) -> rrb.Blueprint:
    """One of the layouts; it follows the newest data. window_s: length of time shown."""
    if name == "wear":
        endless = rrb.TimeRangeBoundary.infinite()
        return _tabbed([_wear_tab(tray.name) for tray in trays], DAYS, rr.TimeRange(start=endless, end=endless))
    if name == "alarms" or trays[0].is_of_fleet:
        pages = pages_of([(tray, fan) for tray in trays for fan in tray.alarmed], ALARMS_ON_A_PAGE)
        tabs = [
            _page_tab(", ".join(f"{tray.name}/{tray.names.cell(fan)}" for tray, fan in page), page) for page in pages
        ]
        logs = list(dict.fromkeys(tray.log for tray in trays))
        tabs = tabs or [rrb.Horizontal(_alarms_view(), _log_view(logs), name="alarms")]
    else:
        of_trays = {tray.name: pages_of([(tray, fan) for fan in range(tray.fans)]) for tray in trays}
        pages = [page for of_tray in of_trays.values() for page in of_tray]
        tabs = [_tray_tab(tray, of_tray) for tray, of_tray in of_trays.items()]
    margin = max((MARGIN_FOR_LEGEND[columns_of(len(page))] for page in pages), default=0.0)
    cursor = rrb.TimeRangeBoundary.cursor_relative
    shown = rr.TimeRange(start=cursor(seconds=-window_s), end=cursor(seconds=margin * window_s))
    return _tabbed(tabs, TIMELINE, shown)


class _Linked(rrb.Blueprint):
    """A blueprint whose linked time axes all show one range."""

    def __init__(self, *parts: Any, shown: rr.TimeRange, **options: bool) -> None:
        super().__init__(*parts, **options)
        self._axis = rrb.TimeAxis(view_range=shown)

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        super()._log_to_stream(stream)
        stream.log(f"{_SHARED_VIEW}/TimeAxis", self._axis)


def _tabbed(tabs: Sequence[rrb.Container | rrb.View], timeline: str, shown: rr.TimeRange) -> rrb.Blueprint:
    return _Linked(
        rrb.Tabs(*tabs, active_tab=0) if len(tabs) > 1 else tabs[0],
        rrb.TopPanel(state="expanded"),
        rrb.TimePanel(timeline=timeline, play_state="following", state="collapsed"),
        shown=shown,
        auto_views=False,
        collapse_panels=True,
    )


def _wear_tab(tray: str) -> rrb.Container:
    view = rrb.TimeSeriesView(
        origin=f"/{wear_path(tray)}",
        name=f"{tray} / speed since commissioning (%)",
        axis_x=LINKED,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),
    )
    return rrb.Grid(view, name=tray)


def columns_of(plots: int) -> int:
    """In how many columns so many plots stand."""
    return 1 if plots <= 2 else 2 if plots <= 4 else 4


def _tray_tab(tray: str, pages: Sequence[Sequence[FanPlot]]) -> rrb.Container:
    if len(pages) == 1:
        return _page_tab(tray, pages[0])
    tabs = [_page_tab(f"{tray} / fans {page[0][1]} to {page[-1][1]}", page) for page in pages]
    return rrb.Tabs(*tabs, active_tab=0, name=tray)


def _page_tab(name: str, plots: Sequence[FanPlot]) -> rrb.Container:
    """Up to `FANS_ON_A_PAGE` fans, each with speed above torque balance and score; their lanes, the alarms, the log."""
    columns = columns_of(len(plots))
    lanes = rrb.StateTimelineView(
        origin="/",
        contents=[f"/{state_path(tray.name, fan, tray.names.name(fan))}" for tray, fan in plots],
        name="state of each fan",
        time_view=LINKED,
    )
    lane_share = max(MIN_LANE_SHARE, (1.6 + len(plots)) / 25)
    above: rrb.Container = rrb.Grid(*(_fan_rows(*plot, columns) for plot in plots), grid_columns=columns)
    if auxiliary := list(dict.fromkeys(column for tray, _ in plots for column in tray.auxiliary)):
        beside = [
            rrb.TimeSeriesView(
                origin="/",
                contents=[f"/{auxiliary_path(tray.name, column.name, fan)}" for tray, fan in plots],
                name=f"{column.title} ({column.unit})",
                axis_x=LINKED,
            )
            for column in auxiliary
        ]
        above = rrb.Vertical(above, rrb.Horizontal(*beside), row_shares=[4, 1])
    logs = list(dict.fromkeys(tray.log for tray, _ in plots))
    return rrb.Vertical(
        above,
        rrb.Horizontal(lanes, _alarms_view(), _log_view(logs), column_shares=[4, 4, 3]),
        row_shares=[1 - lane_share, lane_share],
        name=name,
    )


def _fan_rows(tray: TrayLayout, fan: int, columns: int) -> rrb.Container:
    label = tray.names.label(fan)
    fill, lines = speed_style(tray.speed_unit, 0.0), speed_style(tray.speed_unit, LINE_WIDTH)
    speed = rrb.TimeSeriesView(
        origin=f"/{tray.name}/fan_{fan}",
        contents=[f"/{fan_path(tray.name, fan, part)}" for part in FAN_PARTS],
        name=f"{tray.name} / {label} speed ({tray.speed_unit})",
        axis_x=LINKED,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=columns < FANS_ON_A_PAGE // 2),
        # A single band is faint. Drawing the same data twice makes it solid and sends no more bytes.
        overrides={fan_path(tray.name, fan, "speed"): [fill.visualizer(), lines.visualizer()]},
    )
    page, number = divmod(fan, tray.judged_together)
    on_page = min(tray.judged_together, tray.fans - page * tray.judged_together)
    names = {BALANCE: f"{tray.name} / {label} torque balance", SCORE: f"{tray.name} / {label} score"}
    if columns == 4:  # narrow: a longer name is cut off
        names = {BALANCE: f"balance {fan}", SCORE: f"score {fan}"}
    styles = {BALANCE: balance_style(on_page, number), SCORE: score_style(on_page, number)}
    judged = [
        rrb.TimeSeriesView(
            origin=f"/{judged_path(tray.name, kind, page)}",
            name=name,
            axis_x=LINKED,
            plot_legend=rrb.PlotLegend(visible=False),
            overrides={judged_path(tray.name, kind, page): styles[kind].visualizer()},  # the series of this fan alone
        )
        for kind, name in names.items()
    ]
    return rrb.Vertical(speed, rrb.Horizontal(*judged), row_shares=[5, 3])


def _alarms_view() -> rrb.TextDocumentView:
    return rrb.TextDocumentView(origin=f"/{ALARMS_PATH}", name="alarms")


def _log_view(paths: Sequence[str]) -> rrb.TextLogView:
    return rrb.TextLogView(
        origin="/",
        contents=[f"/{path}" for path in paths],
        name="alarm log",
        columns=TextLogColumns(
            timeline_columns=[TimelineColumn(TIMELINE, visible=False)],  # too narrow to read: lines begin with it
            text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")],
        ),
    )
