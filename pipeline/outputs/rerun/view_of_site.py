"""The view of a site: the core and what it draws into. The viewer stage and what reads recordings build it here."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.rerun import fleet_view
from fantwin.pipeline.outputs.rerun.fleet_view import FLEET_ABOVE, FleetView, is_fleet
from fantwin.pipeline.outputs.rerun.rerun_sink import RerunSink, ViewOptions
from fantwin.pipeline.outputs.rerun.viewer_core import ViewerCore
from fantwin.pipeline.runtime.stage import StageError
from fantwin.schemas.units import NS_PER_S


def view_of_site(
    site: str, trays: Sequence[TrayConfig], started_t_ns: int, file: Path | None, options: ViewOptions
) -> ViewerCore:
    """Open the file and serve the viewers; None leaves the file out.

    Raises:
        StageError: a port is taken, the file cannot be written, or the layout is not one of a fleet.
    """
    fleet = None
    if is_fleet(trays):
        if options.layout == "wear":
            raise StageError(
                f'viewer.layout = "wear": not with more than {FLEET_ABOVE} fans; fantwin wear lists the changes'
            )
        hold_ns, window_ns = round(fleet_view.HOLD_S * NS_PER_S), round(options.window_s * NS_PER_S)
        fleet = FleetView(trays, options.show, fleet_view.ALARM_PLOTS, hold_ns, window_ns)
    return ViewerCore(site, trays, RerunSink(site, trays, started_t_ns, file, options), fleet)
