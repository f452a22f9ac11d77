"""`fantwin twins learn` and `check`: the next version of a tray's learned twin, now."""

from __future__ import annotations

import json

import typer

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
from fantwin.pipeline.config.models import Config, TrayConfig
from fantwin.pipeline.learning.versions import TwinVersions, learning_folder


def learn(settings: Config, of: TrayConfig, *, only_if_changed: bool, json_output: bool) -> None:
    """Make the next version of the twin of a tray, and print it.

    Raises:
        UserError: none can be made, for example because of too little history.
        typer.Exit: Ctrl-C.
    """
    folder, rate = learning_folder(settings.run_folder, of.name), settings.sections["learner"].false_alarms_per_day  # type: ignore[attr-defined]
    doing = f"{'checking' if only_if_changed else 'learning'} the twin of {of.name}"
    with interruptible("no version was made"), working(doing) as show:
        version = make_next_version(folder, of.name, rate, show, only_if_changed=only_if_changed)
    listed = TwinVersions(folder, of.name).read()
    if json_output:
        made, last_check = version and version_as_json(version, listed), listed.check and check_as_json(listed.check)
        typer.echo(json.dumps({"version": made, "check": last_check}))
        return
    if only_if_changed:
        typer.echo(check_line(listed.check) if listed.check else NO_REFERENCE)
    for line in [*version_lines(version, listed), *offer_lines(listed)] if version else []:
        typer.echo(line)
    if version is None and listed.waiting:
        typer.echo(f"no version was made: {listed.waiting.name} is offered already (fantwin twins)")
