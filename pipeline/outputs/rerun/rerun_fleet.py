"""A fleet in Rerun: the worst fans by name, alarms and their log, and a tab with a few plots.

The layout changes only when supply voltage, current or temperature is first measured. A plot has a fixed place, and
the curves of earlier fans in it stay at their times. So nothing moves while an operator works, and a file shows at each
time what was shown then.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fantwin.pipeline.outputs.rerun.fleet_view import Overview
from fantwin.pipeline.outputs.rerun.plot_places import FleetPlots
from fantwin.pipeline.outputs.rerun.rerun_bands import FREE
from fantwin.pipeline.outputs.rerun.rerun_layout import (
    LINKED,
    MARGIN_FOR_LEGEND,
    alarms_view,
    blueprint,
    judged_view,
    log_view,
)
from fantwin.pipeline.outputs.rerun.rerun_paths import (
    BALANCE,
    FLEET_LOG,
    SCORE,
    SHOWN,
    TIMELINE,
    place_beside,
    place_lane,
)
from fantwin.pipeline.outputs.rerun.rerun_styles import LINE_WIDTH, RED, STATE_COLORS, log_state_styles
from fantwin.pipeline.site.trace import state_names
from fantwin.schemas.channels import Channel

WORST, COUNTS = "fleet/worst", "fleet/counts"
COUNT_COLORS = {"in alarm": RED, "suspect": STATE_COLORS["suspect"]}
"""the counts that are plotted; a tray that is not judged would hide the few fans that these are about"""
PLOTS_ON_A_PAGE = 4
COLUMNS = 2  # of plots


class RerunFleet:
    """The overview of a fleet in a recording."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording

    def log_styles(self, places: int) -> None:
        """Log what does not change: the colours of the counts, and the lanes of `places` plots."""
        for name, color in COUNT_COLORS.items():
            style = rr.SeriesLines(names=name, colors=color, widths=LINE_WIDTH)
            self._recording.log(count_path(name), style, static=True)
        for place in range(1, places + 1):
            log_state_styles(self._recording, place_lane(place), [*state_names(), FREE])

    def draw(self, overview: Overview) -> None:
        """Send the counts, and the page if it has changed."""
        if overview.page is not None:
            page = rr.TextDocument.columns(text=[overview.page], media_type=[rr.MediaType.MARKDOWN])
            self._send(WORST, overview.t_ns, page)
        for name in COUNT_COLORS:
            self._send(count_path(name), overview.t_ns, rr.Scalars.columns(scalars=[overview.counts[name]]))

    def _send(self, path: str, t_ns: int, columns: rr.ComponentColumnList) -> None:
        time = rr.TimeColumn(TIMELINE, timestamp=np.array([t_ns], "datetime64[ns]"))
        self._recording.send_columns(path, indexes=[time], columns=columns)


def count_path(name: str) -> str:
    """Entity of the number of fans that are, for example, `in alarm`."""
    return f"{COUNTS}/{name.replace(' ', '_')}"


def fleet_blueprint(
    plots: FleetPlots, window_s: float, auxiliary: Sequence[Channel] = (), *, for_picture: bool = False
) -> rrb.Blueprint:
    """The layout `all` of a fleet. auxiliary: the columns beside command and speed that are drawn."""
    tabs = [_overview_tab(window_s)]
    tabs += [_plots_tab(plots, auxiliary)] if plots.count and not for_picture else []
    return blueprint(tabs, window_s, MARGIN_FOR_LEGEND[COLUMNS], for_picture=for_picture)


def fleet_alarms_blueprint(
    plots: FleetPlots, window_s: float, auxiliary: Sequence[Channel] = (), *, for_picture: bool = False
) -> rrb.Blueprint:
    """The layout `alarms` of a fleet: its plots, which the fans in alarm get."""
    lists = rrb.Horizontal(alarms_view(), log_view([FLEET_LOG], "alarm log"), name="alarms")
    tab = _plots_tab(plots, auxiliary) if plots.count else lists
    return blueprint([tab], window_s, MARGIN_FOR_LEGEND[COLUMNS], for_picture=for_picture)


def _overview_tab(window_s: float) -> rrb.Container:
    """The tab with the worst fans, the alarms and their log, and how many fans were in alarm in the last minutes."""
    cursor = rrb.TimeRangeBoundary.cursor_relative
    minutes = rr.TimeRange(start=cursor(seconds=-10 * window_s), end=cursor(seconds=4 * window_s))
    counts = rrb.TimeSeriesView(
        origin=f"/{COUNTS}",
        name="fans in alarm, suspect",
        axis_x=rrb.TimeAxis(view_range=minutes),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
    )
    worst = rrb.TextDocumentView(origin=f"/{WORST}", name="the worst fans")
    return rrb.Horizontal(
        worst,
        rrb.Vertical(alarms_view(), log_view([FLEET_LOG], "alarm log"), counts, row_shares=[3, 3, 2]),
        column_shares=[1, 1],
        name="fleet",
    )


def _plots_tab(plots: FleetPlots, auxiliary: Sequence[Channel]) -> rrb.Container:
    """The tab with the plots."""
    starts = range(1, plots.count + 1, PLOTS_ON_A_PAGE)
    pages = [
        _plots_page(plots, range(start, min(start + PLOTS_ON_A_PAGE, plots.count + 1)), auxiliary) for start in starts
    ]
    return rrb.Tabs(*pages, active_tab=0, name="plots") if len(pages) > 1 else pages[0]


def _plots_page(plots: FleetPlots, places: Sequence[int], auxiliary: Sequence[Channel]) -> rrb.Container:
    lanes = rrb.StateTimelineView(
        origin=f"/{SHOWN}/state",
        contents=[f"/{place_lane(place)}" for place in places],
        name="state of the fan in each plot",
        time_view=LINKED,
    )
    beside = [
        rrb.TimeSeriesView(
            origin=f"/{SHOWN}/{column.name}",
            contents=[f"/{place_beside(place, column.name)}" for place in places],
            name=f"{column.title} of the fan in each plot ({column.unit})",
            axis_x=LINKED,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
        )
        for column in auxiliary
    ]
    return rrb.Horizontal(
        rrb.Grid(*(_plot_rows(plots, place) for place in places), grid_columns=COLUMNS if len(places) > 1 else 1),
        rrb.Vertical(lanes, *beside, alarms_view(), log_view([FLEET_LOG], "alarm log")),
        column_shares=[7, 3],
        name="plots" if len(places) == plots.count else f"plots {places[0]} to {places[-1]}",
    )


def _plot_rows(plots: FleetPlots, place: int) -> rrb.Container:
    speed = rrb.TimeSeriesView(
        origin=f"/{SHOWN}/plot_{place}",
        name=plots.title(place),
        axis_x=LINKED,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
    )
    kinds = [
        judged_view([place_beside(place, kind)], f"plot {place}: {title}", None)
        for kind, title in ((BALANCE, "torque balance"), (SCORE, "score"))
    ]
    return rrb.Vertical(speed, rrb.Horizontal(*kinds), row_shares=[5, 3])
