"""`fantwin twins`: the versions of a learned twin; which is in force, and what is never learned from."""

from __future__ import annotations

import json
from datetime import datetime
from typing import Annotated

import typer

from pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from pipeline.cli.twins.learn import learning_tray
from pipeline.cli.twins.versions_text import version_lines
from pipeline.config.loading import load_config
from pipeline.errors import UserError
from pipeline.learning.versions import Period, TwinVersions, learning_folder
from schemas.units import NS_PER_S


def twins(
    config: ConfigOption = DEFAULT_CONFIG,
    tray: Annotated[str | None, typer.Option(help="Which tray, where several learn their twins.")] = None,
    use: Annotated[
        str | None, typer.Option(metavar="VERSION", help="Put this version in force: an earlier or an offered one.")
    ] = None,
    faulty_from: Annotated[
        str | None,
        typer.Option("--faulty-from", metavar="TIME", help="Start of a time to mark as faulty; needs --faulty-to."),
    ] = None,
    faulty_to: Annotated[
        str | None,
        typer.Option(
            "--faulty-to", metavar="TIME", help="End of the faulty time. Times are local; a date alone is 00:00."
        ),
    ] = None,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """List the versions of a learned twin, put one in force, or mark a time as faulty: it is never learned from.

    A running site changes to the version in force within seconds. If that was learned from a time that is marked as
    faulty, the newest version that was not takes its place.

    Example: fantwin twins -c fantwin.toml

    Example: fantwin twins --use tray1-2

    Example: fantwin twins --faulty-from 2026-11-23 --faulty-to 2026-11-24
    """
    settings = load_config(config, overrides or (), stages=())
    of = learning_tray(settings, tray)
    versions = TwinVersions(learning_folder(settings.run_folder, of.name), of.name)
    said: list[str] = []
    if faulty_from or faulty_to:
        if not (faulty_from and faulty_to):
            raise UserError("a faulty time has two ends: give --faulty-from and --faulty-to")
        was, now = versions.call_faulty(_period(faulty_from, faulty_to))
        if was:
            said.append(f"{was} was learned from that time; in force now: {now}" if now else _no_other(was))
    if use:
        versions.use(use)
    listed, in_force = versions.all(), versions.in_force()
    name = in_force.name if in_force else ""
    if json_output:
        found = {"tray": of.name, "in_force": name, "faulty": versions.faulty()}
        typer.echo(json.dumps({**found, "versions": [version.model_dump() for version in listed], "notes": said}))
        return
    for line in [*said, *version_lines(listed, name, versions.faulty())]:
        typer.echo(line)
    if not listed:
        typer.echo(f"{of.name} has no twin yet: `fantwin up` makes the first; `fantwin status` says what it waits for")


def _no_other(name: str) -> str:
    stays = f"{name} was learned from that time and stays in force: there is no other version"
    return f"{stays}; the next will not use that time"


def _period(first: str, last: str) -> Period:
    period = (_t_ns(first), _t_ns(last))
    if period[0] >= period[1]:
        raise UserError(f"--faulty-from {first} is not before --faulty-to {last}")
    return period


def _t_ns(text: str) -> int:
    try:
        return round(datetime.fromisoformat(text).astimezone().timestamp() * NS_PER_S)
    except (ValueError, OverflowError, OSError) as error:
        raise UserError(f"{text}: not a time: write 2026-11-24 or 2026-11-24T18:00") from error
