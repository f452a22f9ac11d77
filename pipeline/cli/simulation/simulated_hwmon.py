"""`fantwin simulate --hwmon`: a simulated tray as the fans of a computer, whose faults are injected through a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from fantwin.pipeline.sources.hwmon.chips import chip_of
from fantwin.pipeline.sources.simulated.hwmon import FAULT_FILE
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho

if TYPE_CHECKING:
    from fantwin.simulation.tray import SimulatedTray

RATE_HZ = 20.0
"""at which the files are served"""


def tachos_of(chip: str) -> tuple[Tacho, ...]:
    """The tacho behind the driver of a chip; instantaneous where it is not known, with a note if the chip is not."""
    row = chip_of(chip)
    if row is None:
        typer.echo(f"note: the driver of chip {chip!r} is not known: readings are instantaneous", err=True)
    return (row.tacho,) if row and row.tacho else INSTANTANEOUS


class InjectedFaults:
    """The faults that a file names, one a line as on the command line, besides those of the schedule.

    They begin when the file is written, and end when it no longer names them.
    """

    def __init__(self, tray: SimulatedTray, root: Path) -> None:
        self._tray = tray
        self._file = root / FAULT_FILE
        self._modified_ns = 0
        self._active: dict[str, int] = {}
        """number of the fault in the schedule, by its line"""

    def follow(self) -> None:
        """Read the file again if it has changed."""
        try:
            modified_ns = self._file.stat().st_mtime_ns
            if modified_ns == self._modified_ns:
                return
            lines = [line.strip() for line in self._file.read_text(encoding="utf-8", errors="replace").splitlines()]
        except OSError:
            return
        self._modified_ns = modified_ns
        wanted = dict.fromkeys(filter(None, lines))
        for line in [line for line in self._active if line not in wanted]:
            self._end(self._active.pop(line))
            typer.echo(f"fault removed: {line}", err=True)
        for line in wanted:
            if line not in self._active:
                self._begin(line)

    def _begin(self, line: str) -> None:
        from fantwin.simulation.errors import SimulationError  # noqa: PLC0415  loaded only by the commands that need it
        from fantwin.simulation.faults import parse_fault  # noqa: PLC0415

        tray = self._tray
        faults = tray.settings.faults
        try:
            fault = parse_fault(line)
            begun = replace(fault, start_s=fault.start_s + tray.t_s, stop_s=fault.stop_s + tray.t_s)
            tray.set_faults((*faults, begun))
        except SimulationError as error:
            typer.echo(f"{self._file}: {error}", err=True)
            return
        self._active[line] = len(faults)
        typer.echo(f"fault injected: {line}", err=True)

    def _end(self, number: int) -> None:
        faults = list(self._tray.settings.faults)
        faults[number] = replace(faults[number], stop_s=max(self._tray.t_s, faults[number].start_s + 1e-3))
        self._tray.set_faults(tuple(faults))
