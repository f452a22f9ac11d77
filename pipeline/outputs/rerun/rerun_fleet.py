"""A fleet in Rerun: a map with a cell for every fan, the worst fans by name, alarm log, and a tab with a few plots.

A cell is a point; its class says its colour and, under the mouse, its meaning. The layout changes only when supply
voltage, current or temperature is first measured. A plot has a fixed place, and the curves of earlier fans in it stay
at their times. So nothing moves while an operator works, and a file shows at each time what was shown then.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.outputs.rerun.fleet_map import LABEL_HEIGHT_PX, fleet_map
from fantwin.pipeline.outputs.rerun.fleet_view import FANS_NAMED, Overview
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
from fantwin.pipeline.outputs.rerun.rerun_styles import LINE_WIDTH, RED, STATE_COLORS, UNKNOWN_COLOR, log_state_styles
from fantwin.pipeline.site.fleet import NORMAL_LEVELS, Fan, class_names
from fantwin.pipeline.site.trace import SILENT, state_names
from fantwin.schemas.auxiliary import AuxiliaryColumn
from fantwin.schemas.messages import Array

MAP = "fleet/map"
CELLS, BLOCKS, TRAYS = f"{MAP}/cells", f"{MAP}/blocks", f"{MAP}/trays"
LEGEND, LEGEND_TEXTS = f"{MAP}/legend", f"{MAP}/legend_texts"
ALARMS, ALARM_NAMES = f"{MAP}/alarms", f"{MAP}/alarm_names"
WORST, COUNTS = "fleet/worst", "fleet/counts"
NEAR_THE_LIMIT = (222, 205, 60)
FRAME_COLOR = (128, 128, 128)
COUNT_COLORS = {"in alarm": RED, "suspect": STATE_COLORS["suspect"]}
"""the counts that are plotted; a tray that is not judged would hide the few fans that these are about"""
CELL_RADIUS = 0.44
ALARM_RADIUS_PX = 6.0  # a fan in alarm is seen even where a cell is a few pixels
PLOTS_ON_A_PAGE = 4
COLUMNS = 2  # of plots


def class_colors() -> list[tuple[int, int, int]]:
    """The colours of `class_names`: a normal fan's goes from green to yellow as its score rises to the limit."""
    green, yellow = np.array(STATE_COLORS["normal"]), np.array(NEAR_THE_LIMIT)
    shares = np.linspace(0.0, 1.0, NORMAL_LEVELS)
    normal = [tuple((green + (yellow - green) * share).astype(int).tolist()) for share in shares]
    others = [STATE_COLORS.get(name, UNKNOWN_COLOR) for name in class_names()[NORMAL_LEVELS:-1]]
    return [*normal, *others, STATE_COLORS[SILENT]]


class RerunFleet:
    """The overview of a fleet in a recording."""

    def __init__(self, recording: rr.RecordingStream, trays: Sequence[TrayConfig]) -> None:
        self._recording = recording
        self._map = fleet_map([tray.name for tray in trays], [tray.fans for tray in trays])
        self._trays = [tray.name for tray in trays]
        self._fans = [str(Fan(tray.name, number)) for tray in trays for number in range(tray.fans)]

    @property
    def bounds(self) -> rrb.VisualBounds2D:
        """What the map's view shows."""
        return bounds_of(np.concatenate([self._map.labels, self._map.cells, self._legend_places()]))

    def log_styles(self, places: int) -> None:
        """Log what does not change: the map, its legend, the colours, and the lanes of `places` plots."""
        shown, colors = self._recording, class_colors()
        names = class_names()
        shown.log(
            MAP,
            rr.AnnotationContext(
                [
                    rr.AnnotationInfo(number, name, color)
                    for number, (name, color) in enumerate(zip(names, colors, strict=True))
                ]
            ),
            static=True,
        )
        cells = rr.Points2D.from_fields(
            positions=self._map.cells, radii=[CELL_RADIUS], labels=self._fans, show_labels=False
        )
        shown.log(CELLS, cells, static=True)
        left_top, size = self._map.blocks[:, :2] - 0.15, self._map.blocks[:, 2:] + 0.3
        frames = rr.Boxes2D(mins=left_top, sizes=size, colors=[FRAME_COLOR], radii=rr.Radius.ui_points(0.5))
        shown.log(BLOCKS, frames, static=True)
        self._log_texts(TRAYS, self._map.labels, [self._trays[tray] for tray in self._map.label_trays])
        self._log_legend()
        for name, color in COUNT_COLORS.items():
            style = rr.SeriesLines(names=name, colors=color, widths=LINE_WIDTH)
            shown.log(count_path(name), style, static=True)
        for place in range(1, places + 1):
            log_state_styles(shown, place_lane(place), [*state_names(), FREE])

    def draw(self, overview: Overview) -> None:
        """Send what has changed."""
        if overview.classes is not None:
            columns = rr.Points2D.columns(class_ids=overview.classes.astype(np.uint16))
            self._send(CELLS, overview.t_ns, columns.partition([len(overview.classes)]))
        if overview.alarms is not None:
            self._draw_alarms(overview.t_ns, overview.alarms)
        if overview.page is not None:
            page = rr.TextDocument.columns(text=[overview.page], media_type=[rr.MediaType.MARKDOWN])
            self._send(WORST, overview.t_ns, page)
        for name in COUNT_COLORS:
            self._send(count_path(name), overview.t_ns, rr.Scalars.columns(scalars=[overview.counts[name]]))

    def _draw_alarms(self, t_ns: int, alarms: Sequence[int]) -> None:
        for path, shown in ((ALARMS, alarms), (ALARM_NAMES, alarms[:FANS_NAMED])):
            places = self._map.cells[list(shown)].reshape(-1, 2)
            columns = rr.Points2D.columns(positions=places, labels=[self._fans[index] for index in shown])
            self._send(path, t_ns, columns.partition([len(shown)]))

    def _log_legend(self) -> None:
        names, colors = class_names(), class_colors()
        labels = {0: "normal", NORMAL_LEVELS - 1: "near the limit"}
        shown, places = _legend_classes(), self._legend_places()
        radius = rr.Radius.ui_points(ALARM_RADIUS_PX)
        discs = rr.Points2D(places, radii=radius, colors=[colors[number] for number in shown])
        self._recording.log(LEGEND, discs, static=True)
        self._log_texts(LEGEND_TEXTS, places, [labels.get(number, names[number]) for number in shown])
        style = {"radii": radius, "colors": RED, "draw_order": 40.0}
        self._recording.log(ALARMS, rr.Points2D.from_fields(**style, show_labels=False), static=True)
        self._recording.log(ALARM_NAMES, rr.Points2D.from_fields(**style, show_labels=True), static=True)

    def _legend_places(self) -> Array:
        count = len(_legend_classes())
        x = (np.arange(count) + 0.5) * self._map.width / count
        return np.stack([x, np.full(count, self._map.height + 1.5 * LABEL_HEIGHT_PX / self._map.cell_px)], axis=1)

    def _log_texts(self, path: str, places: Array, texts: Sequence[str]) -> None:
        radius = rr.Radius.ui_points(0.01)
        points = rr.Points2D(places, radii=radius, colors=FRAME_COLOR, labels=texts, show_labels=True)
        self._recording.log(path, points, static=True)

    def _send(self, path: str, t_ns: int, columns: rr.ComponentColumnList) -> None:
        time = rr.TimeColumn(TIMELINE, timestamp=np.array([t_ns], "datetime64[ns]"))
        self._recording.send_columns(path, indexes=[time], columns=columns)


def count_path(name: str) -> str:
    """Entity of the number of fans that are, for example, `in alarm`."""
    return f"{COUNTS}/{name.replace(' ', '_')}"


def bounds_of(places: Array) -> rrb.VisualBounds2D:
    """Bounds around places (n, 2) on the map, with a margin."""
    (left, top), (right, bottom) = places.min(axis=0), places.max(axis=0)
    margin = 0.03 * max(right - left, bottom - top)
    return rrb.VisualBounds2D(x_range=(left - margin, right + margin), y_range=(top - margin, bottom + 2 * margin))


def fleet_blueprint(
    bounds: rrb.VisualBounds2D,
    plots: FleetPlots,
    window_s: float,
    auxiliary: Sequence[AuxiliaryColumn] = (),
    *,
    for_picture: bool = False,
) -> rrb.Blueprint:
    """The layout `all` of a fleet. auxiliary: the columns beside command and speed that are drawn."""
    tabs = [_overview_tab(bounds, window_s)]
    tabs += [_plots_tab(plots, auxiliary)] if plots.count and not for_picture else []
    return blueprint(tabs, window_s, MARGIN_FOR_LEGEND[COLUMNS], for_picture=for_picture)


def fleet_alarms_blueprint(
    plots: FleetPlots, window_s: float, auxiliary: Sequence[AuxiliaryColumn] = (), *, for_picture: bool = False
) -> rrb.Blueprint:
    """The layout `alarms` of a fleet: its plots, which the fans in alarm get."""
    lists = rrb.Horizontal(alarms_view(), log_view([FLEET_LOG], "alarm log"), name="alarms")
    tab = _plots_tab(plots, auxiliary) if plots.count else lists
    return blueprint([tab], window_s, MARGIN_FOR_LEGEND[COLUMNS], for_picture=for_picture)


def _overview_tab(bounds: rrb.VisualBounds2D, window_s: float) -> rrb.Container:
    """The tab with the map, the worst fans, the alarm log, and how many fans were in alarm in the last minutes."""
    cells = rrb.Spatial2DView(origin=f"/{MAP}", name="every fan", visual_bounds=bounds)
    cursor = rrb.TimeRangeBoundary.cursor_relative
    minutes = rr.TimeRange(start=cursor(seconds=-10 * window_s), end=cursor(seconds=4 * window_s))
    counts = rrb.TimeSeriesView(
        origin=f"/{COUNTS}",
        name="fans in alarm, suspect",
        axis_x=rrb.TimeAxis(view_range=minutes),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
    )
    worst = rrb.TextDocumentView(origin=f"/{WORST}", name="the worst fans")
    return rrb.Vertical(
        rrb.Horizontal(cells, worst, column_shares=[7, 3]),
        rrb.Horizontal(alarms_view(), log_view([FLEET_LOG], "alarm log"), counts, column_shares=[4, 3, 3]),
        row_shares=[4, 1],
        name="fleet",
    )


def _plots_tab(plots: FleetPlots, auxiliary: Sequence[AuxiliaryColumn]) -> rrb.Container:
    """The tab with the plots."""
    starts = range(1, plots.count + 1, PLOTS_ON_A_PAGE)
    pages = [
        _plots_page(plots, range(start, min(start + PLOTS_ON_A_PAGE, plots.count + 1)), auxiliary) for start in starts
    ]
    return rrb.Tabs(*pages, active_tab=0, name="plots") if len(pages) > 1 else pages[0]


def _plots_page(plots: FleetPlots, places: Sequence[int], auxiliary: Sequence[AuxiliaryColumn]) -> rrb.Container:
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


def _legend_classes() -> list[int]:
    """The classes that the legend shows: a normal fan far from its limit and near it, and the states."""
    names = class_names()
    states = [number for number, name in enumerate(names) if number >= NORMAL_LEVELS and name != "normal"]
    states.remove(names.index("unknown state"))
    return [0, NORMAL_LEVELS - 1, *states]
