"""What the viewer stage draws into: a Rerun recording, or what a test puts in its place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from fantwin.pipeline.outputs.rerun.alarm_log import LogLine
from fantwin.pipeline.outputs.rerun.wear_points import WearPoints
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.trace import Trace
from fantwin.schemas.messages import Array


class ViewSink(Protocol):
    """Destination of a view. Times are ns since the epoch."""

    def draw(self, trace: Trace) -> None:
        """Show the next stretch of a tray."""
        ...

    def change_states(self, tray: str, fan: int, t_ns: Array, names: Sequence[str]) -> None:
        """Set the state of a fan's lane from each time on."""
        ...

    def show_fans(self, fans: Sequence[Fan]) -> None:
        """Show these fans of a fleet, and no others, from now on."""
        ...

    def draw_wear(self, tray: str, points: Sequence[WearPoints]) -> None:
        """Show the points of the wear of some fans, as far as they are new."""
        ...

    def show_alarms(self, table: str, t_ns: int) -> None:
        """Show this table of alarms, in Markdown, from `t_ns` on."""
        ...

    def log(self, lines: Sequence[LogLine]) -> None:
        """Add lines to the alarm log."""
        ...

    def flush(self) -> None:
        """Write what has been sent, so that it survives a crash of this process. Returns within seconds."""
        ...

    def problem(self) -> str:
        """Why the view is not complete; empty if all is well."""
        ...

    def close(self) -> None:
        """Write everything and close, within seconds."""
        ...
