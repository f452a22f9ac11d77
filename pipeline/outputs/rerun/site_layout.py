"""What the layouts of a site depend on, whether its view is live, a file or a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import rerun.blueprint as rrb

from fantwin.pipeline.outputs.rerun.plot_places import FleetPlots
from fantwin.pipeline.outputs.rerun.rerun_fleet import fleet_blueprint
from fantwin.pipeline.outputs.rerun.rerun_layout import (
    LayoutName,
    TrayLayout,
    alarms_blueprint,
    trays_blueprint,
    wear_blueprint,
)
from fantwin.schemas.channels import Channel


@dataclass(frozen=True)
class SiteLayout:
    """The layouts of a site.

    Attributes:
        trays: with every fan drawn; none of a fleet, but in a picture of some of its fans.
        window_s: length of time shown.
        plots: of a fleet; None: it is none.
        auxiliary: of a fleet, the columns beside command and speed that are drawn.
    """

    trays: tuple[TrayLayout, ...]
    window_s: float
    plots: FleetPlots | None = None
    auxiliary: tuple[Channel, ...] = ()

    def blueprint(self, name: LayoutName = "all", *, for_picture: bool = False) -> rrb.Blueprint:
        """One of the layouts."""
        if name == "wear":
            return wear_blueprint([tray.name for tray in self.trays], for_picture=for_picture)
        if self.plots is None:
            lays_out = trays_blueprint if name == "all" else alarms_blueprint
            return lays_out(self.trays, self.window_s, for_picture=for_picture)
        return fleet_blueprint(self.plots, self.window_s, self.auxiliary, for_picture=for_picture)

    def auxiliary_of(self, tray: str) -> Sequence[Channel]:
        """The columns beside command and speed that are drawn of a tray."""
        return next((each.auxiliary for each in self.trays if each.name == tray), self.auxiliary)

    def with_auxiliary(self, tray: str, columns: Sequence[Channel]) -> SiteLayout:
        """The layouts with these columns drawn of a tray."""
        if not self.trays:
            return replace(self, auxiliary=tuple(columns))
        return self._with_tray(tray, lambda each: replace(each, auxiliary=tuple(columns)))

    def with_alarmed(self, tray: str, fans: Sequence[int]) -> SiteLayout:
        """The layouts with these fans among those that have been in alarm. A fleet's do not depend on it."""
        known = next((each.alarmed for each in self.trays if each.name == tray), fans)
        new = [fan for fan in fans if fan not in known]
        if not new:
            return self
        return self._with_tray(tray, lambda each: replace(each, alarmed=(*each.alarmed, *new)))

    def _with_tray(self, name: str, changed: Callable[[TrayLayout], TrayLayout]) -> SiteLayout:
        return replace(self, trays=tuple(changed(tray) if tray.name == name else tray for tray in self.trays))
