"""`fantwin command`: send a command to one fan."""

from __future__ import annotations

import json
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

import numpy as np
import typer

from pipeline.bus.session import Bus
from pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from pipeline.config.loading import load_config
from pipeline.config.models import TrayConfig
from pipeline.errors import UserError
from pipeline.launch.site_watcher import SiteWatcher
from pipeline.runtime.signals import stop_on_signals
from schemas.codec import encode, type_name
from schemas.messages import Command, Header, Health
from schemas.topics import BY_NAME, tray_key
from schemas.units import RAD_S_PER_UNIT

_ANSWER_S = 5.0  # acquisition sends several health messages in this time, with what it has received
_POLL_S = 0.02


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

    Example: fantwin command -c fantwin.toml --fan 0 0.6
    """
    settings = load_config(config, overrides or (), stages=())
    names = [each.name for each in settings.trays]
    if tray is None and len(names) > 1:
        raise UserError(f"name the tray with --tray (trays: {', '.join(names)})")
    chosen = settings.tray(tray or names[0])
    number, value = fan
    message = _message(chosen, number, value, set_point)
    stop = threading.Event()
    stop_on_signals(stop)
    with Bus(settings.bus, stop, listens=False) as bus:
        _send(bus, SiteWatcher(bus, settings.site), settings.site, chosen.name, message, stop)
    kind, unit = ("set-point", f" {chosen.speed_unit}") if set_point else ("command", "")
    if json_output:
        typer.echo(json.dumps({"tray": chosen.name, "fan": number, "kind": kind, "value": value, "unit": unit.strip()}))
    else:
        typer.echo(f"{chosen.name}, fan {number}: {kind} {value:g}{unit} sent")


def _message(tray: TrayConfig, fan: int, value: float, is_set_point: bool) -> Command:
    """The command for one fan of a tray, without a header; NaN leaves the other fans as they are."""
    if not 0 <= fan < tray.fans:
        raise UserError(f"--fan {fan}: tray {tray.name} has fans 0 to {tray.fans - 1}")
    low, high = (-tray.speed_max, tray.speed_max) if is_set_point else (tray.command_min, tray.command_max)
    if not low <= value <= high:  # NaN is in no range
        what = f"set-point, {tray.speed_unit}," if is_set_point else "command"
        raise UserError(f"--fan {fan} {value:g}: the {what} must be within {low:g} to {high:g} of tray {tray.name}")
    wanted, unchanged = np.full((2, tray.fans), np.nan)
    wanted[fan] = value * RAD_S_PER_UNIT[tray.speed_unit] if is_set_point else value
    columns = (unchanged, wanted) if is_set_point else (wanted, unchanged)
    return Command(fans=tray.fans, t_ns=time.time_ns(), command=columns[0], set_point_rad_s=columns[1])


def _send(bus: Bus, watcher: SiteWatcher, site: str, tray: str, message: Command, stop: threading.Event) -> None:
    """Publish the command once acquisition is alive, and wait until its health confirms that it was received.

    Raises:
        UserError: acquisition did not receive the command, or could not send it to the device.
    """
    not_received = f"no acquisition of tray {tray} received the command: is `fantwin up` running?"
    producer = f"command-{tray}-{secrets.token_hex(4)}"
    key = tray_key(site, tray, "command")
    publisher = bus.publisher(key, BY_NAME["command"], type_name(Command), producer)

    def acquisition() -> Health | None:
        return next(
            (
                view.health
                for view in watcher.stages()
                if view.alive and (view.health.stage, view.health.instance) == ("acquisition", tray)
            ),
            None,
        )

    def received() -> Health | None:
        health = acquisition()
        confirmed = health and any(line.producer == producer and line.received for line in health.inputs)
        return health if confirmed else None

    before = _wait(acquisition, stop, not_received)
    header = Header(producer, publisher.published, tray)
    publisher.put(encode(replace(message, header=header)))
    after = _wait(received, stop, not_received)
    if _not_sent(after) > (_not_sent(before) if after.header.producer == before.header.producer else 0):
        raise UserError(f"tray {tray}: acquisition could not send the command: {after.problem or 'it was refused'}")


def _wait(find: Callable[[], Health | None], stop: threading.Event, error: str) -> Health:
    until_s = time.monotonic() + _ANSWER_S
    while (found := find()) is None:
        if time.monotonic() > until_s or stop.wait(_POLL_S):
            raise UserError(error)
    return found


def _not_sent(health: Health) -> int:
    return sum(c.value for c in health.counters if c.name in ("lost_commands", "refused_commands"))
