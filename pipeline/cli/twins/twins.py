"""`fantwin twins`: the versions of a learned twin; which is in force, and what is never learned from."""

from __future__ import annotations

import json
from datetime import datetime
from typing import Annotated

import typer

from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from fantwin.pipeline.cli.twins.learn import learning_tray
from fantwin.pipeline.cli.twins.versions_text import list_as_json, list_lines
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.errors import UsageError
from fantwin.pipeline.learning.versions import TimeSpan, TwinVersions, learning_folder
from fantwin.schemas.units import NS_PER_S

CONSEQUENCE = "alarms are discarded and what was learned of the fans begins again, unless only the calibration differs"


def twins(
    config: ConfigOption = DEFAULT_CONFIG,
    tray: Annotated[str | None, typer.Option(help="Which tray, where several learn their twins.")] = None,
    use: Annotated[
        str | None, typer.Option(metavar="VERSION", help="Put this version in force: an earlier or an offered one.")
    ] = None,
    faulty_from: Annotated[
        str | None,
        typer.Option(
            "--faulty-from", metavar="TIME", help="Start of a time span to mark as faulty; needs --faulty-to."
        ),
    ] = None,
    faulty_to: Annotated[
        str | None,
        typer.Option(
            "--faulty-to", metavar="TIME", help="End of that time span. Times are local; a date alone is 00:00."
        ),
    ] = None,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """List the versions of a learned twin, put one in force, or mark a time span as faulty (not used for learning).

    A running site changes to the version in force within seconds. If the version in force was learned from a faulty
    time span, the newest version that was not learned from it takes its place. Unless only the limits differ, alarms
    are discarded and baselines start again.

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
            raise UsageError("a faulty time has two ends: give --faulty-from and --faulty-to")
        was, now = versions.mark_faulty(_time_span(faulty_from, faulty_to))
        if was:
            replaced = f"{was} was learned from that time span; in force now: {now}; on a running site {CONSEQUENCE}"
            said.append(replaced if now else _no_other(was))
    if use:
        versions.use(use)
        said.append(f"{use} is put in force: on a running site {CONSEQUENCE}, until the next version takes over")
        if versions.read().is_tainted:
            said.append(f"{use} was learned from a time span that is marked as faulty: another version will replace it")
    listed = versions.read()
    if json_output:
        typer.echo(json.dumps({"tray": of.name, **list_as_json(listed), "notes": said}))
        return
    for line in [*said, *list_lines(listed)]:
        typer.echo(line)
    if not listed.versions:
        typer.echo(f"{of.name} has no twin yet: `fantwin up` makes the first; `fantwin status` says what it waits for")


def _no_other(name: str) -> str:
    stays = f"{name} was learned from that time span and stays in force: no version can replace it"
    return f"{stays}; the next will not use that time span"


def _time_span(first: str, last: str) -> TimeSpan:
    span = (_t_ns("--faulty-from", first), _t_ns("--faulty-to", last))
    if span[0] >= span[1]:
        raise UsageError(f"--faulty-from {first} is not before --faulty-to {last}")
    return span


def _t_ns(option: str, text: str) -> int:
    try:
        return round(datetime.fromisoformat(text).astimezone().timestamp() * NS_PER_S)
    except (ValueError, OverflowError, OSError) as error:
        raise UsageError(f"{option} {text}: not a time: write 2026-11-24 or 2026-11-24T18:00") from error
