"""`fantwin command`: send a command to one fan."""

from __future__ import annotations

import json
import threading
from typing import Annotated

import typer

from fantwin.pipeline.bus.session import join_bus
from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from fantwin.pipeline.cli.watch.commanding import (
    CommandSender,
    chosen_tray,
    command_of,
    require_commandable,
    share_note,
)
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.roles import OPERATOR
from fantwin.pipeline.runtime.signals import stop_on_signals


def command(
    fan: Annotated[tuple[int, float], typer.Option("--fan", metavar="N VALUE", help="The fan and its command.")],
    config: ConfigOption = DEFAULT_CONFIG,
    tray: Annotated[str | None, typer.Option(help="The tray; required if there are several.")] = None,
    set_point: Annotated[
        bool,
        typer.Option(
            "--set-point", help="VALUE is a speed in the tray's speed unit, for a device with its own controller."
        ),
    ] = False,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """Send a command to one fan, and wait until acquisition has sent it to the device.

    A command is in the unit of the line, from command_min to command_max of the tray. The fan keeps it until something
    sets another.

    Example: fantwin command -c fantwin.toml --fan 0 0.6
    """
    settings = load_config(config, overrides or (), stages=())
    chosen = chosen_tray(settings, tray)
    require_commandable(chosen, "")
    number, value = fan
    message = command_of(chosen, {number: value}, is_set_point=set_point)
    stop = threading.Event()
    stop_on_signals(stop)
    with join_bus(settings, listens=False, roles=(OPERATOR,)) as bus:
        sender = CommandSender(bus, settings.site, chosen.name, stop)
        sender.connect()
        sender.send(message)
        sender.confirm()
    kind, unit = ("set-point", f" {chosen.speed_unit}") if set_point else ("command", "")
    if json_output:
        typer.echo(json.dumps({"tray": chosen.name, "fan": number, "kind": kind, "value": value, "unit": unit.strip()}))
    else:
        typer.echo(f"{chosen.name}, fan {number}: {kind} {value:g}{unit} sent")
    if not set_point and (note := share_note(chosen, value)):
        typer.echo(note, err=True)
