"""`fantwin` without a command: what to do next on this computer, in two or three lines."""

from __future__ import annotations

import shlex
from pathlib import Path

import typer

from fantwin.pipeline.bus.endpoint import accepts_connections
from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.cli.options import DEFAULT_CONFIG
from fantwin.pipeline.config.settings import Config, ConfigError, TrayConfig
from fantwin.pipeline.launch.this_host import load_for_any_host
from fantwin.pipeline.learning.versions import TwinVersions, learning_folder

_HELP = "fantwin --help lists all commands"


def show_next_step(path: Path = DEFAULT_CONFIG) -> None:
    """Print what is here and the command that comes next."""
    for line in (*_lines(path), _HELP):
        typer.echo(line)


def _lines(path: Path) -> tuple[str, ...]:
    if not path.exists():
        return (
            f"no {path} in this folder; next: fantwin init  (finds fans and writes it)",
            "or: fantwin demo  (eight simulated fans and two faults, one minute)",
        )
    try:
        config = load_for_any_host(path, stages=())
    except ConfigError as error:
        return (f"{error}", "next: correct it; fantwin doctor checks it again")
    if _runs(config):
        return (f"site {config.site!r} runs; next: fantwin status, fantwin alarms",)
    lacks = what_lacks(config)
    nexts = (f"next: {command}  ({why})" for command, why in next_commands(config))
    learns = ("or: fantwin up  (learns it while the plant moves the fans)",) if lacks else ()
    return (f"{path}: site {config.site!r}, {lacks or 'every tray has a twin'}", *nexts, *learns)


def what_lacks(config: Config) -> str:
    """Which trays have no twin yet; empty if all have one."""
    lacking = [tray.name for tray in config.trays if not _has_twin(tray, config)]
    return f"no twin yet of tray {', '.join(lacking)}" if lacking else ""


def next_commands(config: Config) -> list[tuple[str, str]]:
    """What to type, one after the other, so that the fans of a configuration are watched; and why."""
    named = "" if config.path == DEFAULT_CONFIG else f" -c {shlex.quote(str(config.path))}"
    lacking = [tray.source for tray in config.trays if not _has_twin(tray, config)]
    if not lacking:
        return [(f"fantwin up{named}", "watches the fans")]
    doctor = (f"fantwin doctor{named}", "shows what the devices send: are the units right?")
    takes_commands = not any(source.why_no_commands for source in lacking)
    moved = (" --sweep", "moves healthy fans") if takes_commands else ("", "records healthy fans that the plant moves")
    commission = (f"fantwin commission{named}{moved[0]}", f"{moved[1]}, makes their twin, and watches them")
    return [*([doctor] if any(source.kind != "hwmon" for source in lacking) else ()), commission]


def _has_twin(tray: TrayConfig, config: Config) -> bool:
    """Whether a twin is named, or was learned."""
    versions = TwinVersions(learning_folder(config.run_folder, tray.name), tray.name)
    return tray.twin is not None or versions.in_force() is not None


def _runs(config: Config) -> bool:
    """Whether processes of the site run where it meets."""
    if not accepts_connections(config.bus.endpoint):
        return False
    from fantwin.pipeline.cli.watch.doctor import running_sessions  # noqa: PLC0415  takes a second to import

    try:
        return bool(running_sessions(config))
    except BusError:
        return False
