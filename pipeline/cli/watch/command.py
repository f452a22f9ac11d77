"""`fantwin command`: send a command to one fan, or move all of them over their range."""

from __future__ import annotations

from typing import Annotated

import typer

from fantwin.pipeline.acquisition.command_sender import (
    CommandSender,
    chosen_tray,
    command_of,
    require_commandable,
    share_note,
)
from fantwin.pipeline.bus.session import join_bus
from fantwin.pipeline.cli.options import (
    DEFAULT_CONFIG,
    ConfigOption,
    HighOption,
    JsonOption,
    LowOption,
    RoundsOption,
    SafeOption,
    SetOption,
)
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.roles import OPERATOR
from fantwin.pipeline.errors import UsageError
from fantwin.pipeline.runtime.signals import stop_on_signals


def command(
    fan: Annotated[
        tuple[str, float] | None,
        typer.Option("--fan", metavar="FAN VALUE", help="The fan, by its name or number, and its command."),
    ] = None,
    config: ConfigOption = DEFAULT_CONFIG,
    tray: Annotated[str | None, typer.Option(help="The tray; required if there are several.")] = None,
    set_point: Annotated[
        bool,
        typer.Option(
            "--set-point", help="VALUE is a speed in the tray's speed unit, for a device with its own controller."
        ),
    ] = False,
    sweep: Annotated[
        bool, typer.Option("--sweep", help="Move the fans over their range instead, for a recording to train on.")
    ] = False,
    fans: Annotated[
        str, typer.Option(metavar="all|FAN,FAN,...", help="With --sweep: the fans that are moved.")
    ] = "all",
    low: LowOption = None,
    high: HighOption = None,
    safe: SafeOption = None,
    rounds: RoundsOption = 2,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """Send a command to one fan, or move the commands of all over their range while `fantwin up` records.

    A command is in the unit of the line, from command_min to command_max of the tray. The fan keeps it until something
    sets another.

    --sweep moves the fans up and down, with long steps and short ones, as fast as the fans follow. Two steps show how
    fast that is; nothing else may set the commands meanwhile. At the end, after Ctrl-C and after an error each fan gets
    the command of --safe, or the one it had before.

    Example: fantwin command -c fantwin.toml --fan 0 0.6

    Example: fantwin command --sweep --low 0.2
    """
    if (fan is None) is not sweep:
        raise UsageError("say what to send: --fan FAN VALUE, or --sweep")
    settings = load_config(config, overrides or (), stages=())
    chosen = chosen_tray(settings, tray)
    if fan is None:
        from fantwin.pipeline.cli.watch.sweep import sweep as move  # noqa: PLC0415  one command needs no excitation

        move(settings, chosen, fans, low, high, safe, rounds, json_output=json_output)
        return
    require_commandable(chosen, "")
    number, value = chosen.fan_called(fan[0]), fan[1]
    message = command_of(chosen, {number: value}, is_set_point=set_point)
    stop = stop_on_signals()
    with join_bus(settings, listens=False, roles=(OPERATOR,)) as bus:
        sender = CommandSender(bus, settings.site, chosen.name, stop)
        sender.connect()
        sender.send(message)
        sender.confirm()
    kind, unit = ("set-point", f" {chosen.speed_unit}") if set_point else ("command", "")
    found = {
        "tray": chosen.name,
        "fan": number,
        "name": chosen.names.name(number),
        "kind": kind,
        "value": value,
        "unit": unit.strip(),
    }
    show(found, f"{chosen.name}, {chosen.label(number)}: {kind} {value:g}{unit} sent", json_output=json_output)
    if not set_point and (note := share_note(chosen, value)):
        typer.echo(note, err=True)
