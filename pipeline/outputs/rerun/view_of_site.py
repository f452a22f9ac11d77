"""The view of a site: the core and what it draws into. The viewer stage and what reads recordings build it here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.outputs.rerun.fleet_view import FleetView
from fantwin.pipeline.outputs.rerun.rerun_layout import LayoutName
from fantwin.pipeline.outputs.rerun.rerun_sink import RerunSink
from fantwin.pipeline.outputs.rerun.viewer_core import ViewerCore
from fantwin.pipeline.runtime.stage import StageError
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.units import NS_PER_S

NO_WEAR = 'viewer.layout = "wear": not with more than {fleet_above} fans; fantwin wear lists the changes'


@dataclass(frozen=True)
class ViewOptions:
    """What the view itself depends on, with the defaults of `[viewer]`."""

    layout: LayoutName = "all"
    window_s: float = 30.0
    fleet_above: int = 64
    show: Sequence[Fan] = ()
    alarm_plots: int = 8
    alarm_plot_hold_s: float = 60.0
    memory_limit: str = "256MB"
    file_bytes: float = math.inf
    """size at which the file ends; the viewer sets one"""


def view_of_site(
    site: str,
    trays: Sequence[TrayConfig],
    started_t_ns: int,
    file: Path | None,
    options: ViewOptions,
    *,
    grpc_port: int | None = None,
    web_port: int | None = None,
) -> ViewerCore:
    """Open the file and serve the viewers; None leaves one out.

    Raises:
        StageError: a port is taken, the file cannot be written, or the layout is not one of a fleet.
    """
    is_fleet = sum(tray.fans for tray in trays) > options.fleet_above
    if is_fleet and options.layout == "wear":
        raise StageError(NO_WEAR.format(fleet_above=options.fleet_above))
    sink = RerunSink(
        name=site,
        trays=trays,
        is_fleet=is_fleet,
        started_t_ns=started_t_ns,
        layout=options.layout,
        window_s=options.window_s,
        file=file,
        grpc_port=grpc_port,
        web_port=web_port,
        memory_limit=options.memory_limit,
        file_bytes=options.file_bytes,
    )
    fleet = None
    if is_fleet:
        hold_ns, window_ns = round(options.alarm_plot_hold_s * NS_PER_S), round(options.window_s * NS_PER_S)
        fleet = FleetView(trays, options.show, options.alarm_plots, hold_ns, window_ns)
    return ViewerCore(site, trays, sink, fleet)
