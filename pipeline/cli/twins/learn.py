"""`fantwin learn`: the next version of a tray's learned twin, now."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from typing import Annotated

import typer

from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from fantwin.pipeline.cli.progress import interruptible, working
from fantwin.pipeline.cli.twins.next_version import make_next_version
from fantwin.pipeline.cli.twins.versions_text import (
    NO_REFERENCE,
    check_as_json,
    check_line,
    offer_lines,
    version_as_json,
    version_lines,
)
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.models import Config, TrayConfig
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.learning.versions import TwinVersions, learning_folder


def learn(
    config: ConfigOption = DEFAULT_CONFIG,
    tray: Annotated[str | None, typer.Option(help="Which tray, where several learn their twins.")] = None,
    check: Annotated[
        bool,
        typer.Option("--check", help="Compare the fans with the reference; make a version only if they have changed."),
    ] = False,
    overrides: SetOption = None,
    json_output: JsonOption = False,
    until_stdin_closes: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Make the next version of a learned twin from the tray's healthy history, as `fantwin up` does by itself.

    The new version takes over within seconds, also on a running site, unless it is only offered. `fantwin twins` lists
    the versions.

    Exit codes: 0 a version was made, or --check found no new change; 1 error, such as too little history; 130 Ctrl-C.

    Example: fantwin learn -c fantwin.toml

    Example: fantwin learn --check
    """
    if until_stdin_closes:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))  # it runs while no stage does
        threading.Thread(target=_end_with_parent, daemon=True).start()
    settings = load_config(config, overrides or (), stages=("learner",))
    of = learning_tray(settings, tray)
    folder = learning_folder(settings.run_folder, of.name)
    section = settings.sections["learner"]
    with (
        interruptible("no version was made"),
        working(f"{'checking' if check else 'learning'} the twin of {of.name}") as show,
    ):
        version = make_next_version(
            folder,
            of.name,
            section.false_alarms_per_day,  # type: ignore[attr-defined]
            show,
            only_if_changed=check,
        )
    listed = TwinVersions(folder, of.name).read()
    if json_output:
        made, last_check = version and version_as_json(version, listed), listed.check and check_as_json(listed.check)
        typer.echo(json.dumps({"version": made, "check": last_check}))
        return
    if check:
        typer.echo(check_line(listed.check) if listed.check else NO_REFERENCE)
    for line in [*version_lines(version, listed), *offer_lines(listed)] if version else []:
        typer.echo(line)
    if version is None and listed.waiting:
        typer.echo(f"no version was made: {listed.waiting.name} is offered already (fantwin twins)")


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
