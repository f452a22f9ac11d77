"""`fantwin discover`: the fans and serial ports of this computer, with a [[tray]] to paste for each."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from pipeline.cli.options import JsonOption
from pipeline.devices.discovery import Found, discover_hwmon, discover_serial
from pipeline.devices.hwmon_config import ROOT
from pipeline.errors import UserError


def discover(
    root: Annotated[Path, typer.Option(help="Folder of the hwmon chips.")] = ROOT,
    write: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a configuration of all hwmon chips with fans to this new file."),
    ] = None,
    writable: Annotated[
        bool, typer.Option("--writable", help="Let fantwin command the fans found: `sweep` and `command` need that.")
    ] = False,
    json_output: JsonOption = False,
) -> None:
    """List the fans and serial ports of this computer, with a configuration to paste for each, and what is missing.

    It writes nothing to a device. Exit code 1 if nothing can be watched.

    Example: fantwin discover --write fantwin.toml
    """
    shows_progress = not json_output and Console(stderr=True).is_terminal
    found: list[Found] = []
    for each in chain(discover_hwmon(root.absolute() if root != ROOT else root, writable=writable), discover_serial()):
        if shows_progress:
            typer.echo(f"{each.title} ...", err=True)
        found.append(each)
    if json_output:
        typer.echo(json.dumps([asdict(each) | {"toml": each.toml} for each in found]))
    else:
        for each in found:
            _show(each)
    if write:
        _write(write, [each for each in found if each.kind == "hwmon" and each.tray])
        typer.echo(f"written: {write}; next: fantwin doctor -c {write}", err=json_output)
    if not any(each.tray for each in found):
        raise typer.Exit(1)


def _show(found: Found) -> None:
    console = Console(soft_wrap=True, highlight=False)
    if found.tray:
        console.print(found.toml, markup=False)
        return
    for line in found.missing or ("cannot be watched",):
        console.print(f"{found.kind}: {found.title}: {line}", markup=False)


def _write(path: Path, found: Iterable[Found]) -> None:
    trays = [each.toml for each in found]
    if not trays:
        raise UserError(f"{path}: not written: no hwmon chip has a fan to watch")
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write("\n".join(['site = "site"\n', *trays]))
    except FileExistsError as error:
        raise UserError(f"{path}: exists; name a new file, or paste what is shown") from error
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}; name another file") from error
