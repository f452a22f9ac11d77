"""`fantwin twins`: the versions of a learned twin; which is in force, the next one, what is never learned from."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Sequence
from datetime import datetime
from enum import StrEnum
from typing import Annotated

import typer

from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from fantwin.pipeline.cli.twins.versions_text import list_as_json, list_lines
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.models import Config, TrayConfig
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.learning.learning_process import VARIABLE
from fantwin.pipeline.learning.versions import TwinVersions, learning_folder
from fantwin.schemas.units import NS_PER_S

CONSEQUENCE = "alarms are discarded and what was learned of the fans begins again, unless only the calibration differs"


class VersionAction(StrEnum):
    """What can be done with the versions of a twin."""

    LIST = "list"
    LEARN = "learn"
    CHECK = "check"
    USE = "use"
    FAULTY = "faulty"


_TAKES = {VersionAction.USE: ("VERSION",), VersionAction.FAULTY: ("FROM", "TO")}


def twins(
    asked: Annotated[
        VersionAction, typer.Argument(metavar="[ACTION]", help=f"{', '.join(VersionAction)}.")
    ] = VersionAction.LIST,
    values: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[VALUE]...",
            help="use: the version; faulty: start and end, local times as 2026-11-24T18:00; a date alone is 00:00.",
        ),
    ] = None,
    config: ConfigOption = DEFAULT_CONFIG,
    tray: Annotated[str | None, typer.Option(help="Which tray, where several learn their twins.")] = None,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """List the versions of a learned twin, make the next one, put one in force, or mark a time span as faulty.

    learn makes the next version from the tray's healthy history, as `fantwin up` does by itself; check makes one only
    if the fans have changed. use puts an earlier version or an offered one in force. What lies in a faulty time span is
    never learned from; if the version in force was, the newest version that was not takes its place.

    A running site changes to the version in force within seconds. Unless only the limits differ, alarms are discarded
    and baselines start again.

    Exit codes: 0 done, or check found no new change; 1 error, such as too little history; 130 Ctrl-C.

    Example: fantwin twins -c fantwin.toml

    Example: fantwin twins use tray1-2

    Example: fantwin twins faulty 2026-11-23 2026-11-24
    """
    given, takes = values or [], _TAKES.get(asked, ())
    if len(given) != len(takes):
        raise UsageError(
            f"give {' and '.join(takes) or 'nothing'} after {asked}: {' '.join(('fantwin twins', asked, *takes))}"
        )
    if VARIABLE in os.environ:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))  # it runs while no stage does
        threading.Thread(target=_end_with_parent, daemon=True).start()
    settings = load_config(config, overrides or (), stages=("learner",))
    of = learning_tray(settings, tray)
    if asked in (VersionAction.LEARN, VersionAction.CHECK):
        from fantwin.pipeline.cli.twins.learn import learn  # noqa: PLC0415  scoring is loaded only where it is needed

        learn(settings, of, only_if_changed=asked is VersionAction.CHECK, json_output=json_output)
        return
    versions = TwinVersions(learning_folder(settings.run_folder, of.name), of.name)
    said = _faulty(versions, given) if asked is VersionAction.FAULTY else []
    if asked is VersionAction.USE:
        (use,) = given
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


def _faulty(versions: TwinVersions, ends: Sequence[str]) -> list[str]:
    """Mark a time span; returns what follows, in a line."""
    first, last = ends
    span = (_t_ns(first), _t_ns(last))
    if span[0] >= span[1]:
        raise UsageError(f"faulty {first} {last}: the first time is not before the last")
    was, now = versions.mark_faulty(span)
    if not was:
        return []
    replaced = f"{was} was learned from that time span; in force now: {now}; on a running site {CONSEQUENCE}"
    return [replaced if now else _no_other(was)]


def _no_other(name: str) -> str:
    stays = f"{name} was learned from that time span and stays in force: no version can replace it"
    return f"{stays}; the next will not use that time span"


def _t_ns(text: str) -> int:
    try:
        return round(datetime.fromisoformat(text).astimezone().timestamp() * NS_PER_S)
    except (ValueError, OverflowError, OSError) as error:
        raise UsageError(f"faulty {text}: not a time: write 2026-11-24 or 2026-11-24T18:00") from error


def learning_tray(settings: Config, name: str | None) -> TrayConfig:
    """The tray called `name`, or the only one that learns its twin.

    Raises:
        UserError: there is none, or several; or it names a twin.
    """
    learning = [tray for tray in settings.trays if tray.twin is None]
    chosen = [settings.tray(name)] if name else learning
    if len(chosen) > 1:
        names = ", ".join(each.name for each in chosen)
        raise UsageError(f"several trays learn their twins: choose one with --tray: {names}")
    if not chosen or chosen[0] not in learning:
        which = f"tray {chosen[0].name} names" if chosen else "every tray names"
        raise UserError(f"{settings.path}: {which} a twin: remove `twin` from [[tray]] to learn one")
    return chosen[0]


def _end_with_parent() -> None:
    """The stage that started this process holds its standard input open."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
