"""A simulated tray, or a played file, on a serial line or behind a tree of files, until it ends or Ctrl-C."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from fantwin.pipeline.cli.simulation.simulated_hwmon import InjectedFaults
from fantwin.pipeline.runtime.signals import stop_on_signals
from fantwin.pipeline.sources.simulated.device import PlaybackCounts, PseudoTerminal, play, wait_for_reader
from fantwin.pipeline.sources.simulated.hwmon import FAULT_FILE, HwmonTree, play_hwmon
from fantwin.pipeline.sources.simulated.table import TableDevice
from fantwin.schemas import wire
from fantwin.schemas.units import RAD_S_PER_UNIT, SpeedUnit

if TYPE_CHECKING:
    from fantwin.simulation.tray import SimulatedTray


def serve_line(
    device: SimulatedTray | TableDevice,
    link: Path | None,
    protocol: wire.Protocol,
    speed_unit: SpeedUnit,
    on_start: Callable[[int], None],
    *,
    wait: bool,
    err: bool,
) -> PlaybackCounts:
    """Play the device on a pseudo-terminal. wait: for a reader. err: say on stderr where it is."""
    stop = threading.Event()
    stop_on_signals(stop)
    line = PseudoTerminal(link)
    try:
        fans_on = "1 fan on" if device.fans == 1 else f"{device.fans} fans on"
        typer.echo(f"{fans_on} {link or line.port}: {protocol}, speeds in {speed_unit}", err=err)
        if wait:
            wait_for_reader(line, protocol, stop)
        return play(device, line, protocol, RAD_S_PER_UNIT[speed_unit], stop, on_start)
    finally:
        line.close()


def serve_hwmon(tray: SimulatedTray, root: Path, chip: str, *, err: bool) -> PlaybackCounts:
    """Run the tray behind a tree of files until Ctrl-C. err: say where on stderr."""
    stop = threading.Event()
    stop_on_signals(stop)
    tree = HwmonTree(root, chip, tray.fans)
    try:
        typer.echo(
            f"{tray.fans} fans of {chip} in {root}; faults: echo tacho-stuck:fan=0 > {root / FAULT_FILE}", err=err
        )
        return play_hwmon(tray, tree, stop, InjectedFaults(tray, root).follow)
    finally:
        tree.close()
