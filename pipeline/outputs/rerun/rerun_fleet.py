"""A fleet in Rerun: alarms and their log, and plots of the fans that are in alarm or asked for.

The layout changes only when supply voltage, current or temperature is first measured. A plot has a fixed place, and
the curves of earlier fans in it stay at their times. So nothing moves while an operator works, and a file shows at each
time what was shown then.
"""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr
import rerun.blueprint as rrb

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
    place_beside,
    place_lane,
)
from fantwin.pipeline.outputs.rerun.rerun_styles import log_state_styles
from fantwin.pipeline.site.trace import state_names
from fantwin.schemas.channels import Channel

PLOTS_ON_A_PAGE = 4
COLUMNS = 2  # of plots


def log_plot_styles(recording: rr.RecordingStream, places: int) -> None:
    """Log what does not change: the state lanes of `places` plots."""
    for place in range(1, places + 1):
        log_state_styles(recording, place_lane(place), [*state_names(), FREE])


def fleet_blueprint(
    plots: FleetPlots, window_s: float, auxiliary: Sequence[Channel] = (), *, for_picture: bool = False
) -> rrb.Blueprint:
    """The layout of a fleet: its plots. auxiliary: the columns beside command and speed that are drawn."""
    starts = range(1, plots.count + 1, PLOTS_ON_A_PAGE)
    pages = [
        _plots_page(plots, range(start, min(start + PLOTS_ON_A_PAGE, plots.count + 1)), auxiliary) for start in starts
    ]
    lists = rrb.Horizontal(alarms_view(), log_view([FLEET_LOG], "alarm log"), name="alarms")
    tab = rrb.Tabs(*pages, active_tab=0, name="plots") if len(pages) > 1 else pages[0] if pages else lists
    return blueprint([tab], window_s, MARGIN_FOR_LEGEND[COLUMNS], for_picture=for_picture)


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
