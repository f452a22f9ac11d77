"""`fantwin` without a command: what to do next on this computer, in two or three lines."""

from __future__ import annotations

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
    lacking = [tray.name for tray in config.trays if not _has_twin(tray, config)]
    if not lacking:
        return (f"{path}: site {config.site!r}, every tray has a twin; next: fantwin up",)
    what = f"{path}: site {config.site!r}, no twin yet of tray {', '.join(lacking)}"
    return (
        f"{what}; next: fantwin commission  (records healthy fans and makes it)",
        "or: fantwin up  (learns it while the plant moves the fans)",
    )


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
