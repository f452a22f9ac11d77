"""`fantwin doctor find` and `fantwin doctor notify`: the fans and serial ports of this computer, and a test message."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path

import typer
from rich.console import Console

from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.outputs.notify.config import NotifierConfig
from fantwin.pipeline.outputs.notify.targets import send_test
from fantwin.pipeline.outputs.notify.wording import Place
from fantwin.pipeline.sources.hwmon.config import ROOT
from fantwin.pipeline.sources.hwmon.discovery import Found, discover_hwmon, discover_serial


def find_fans(root: Path, write: Path | None, *, writable: bool, json_output: bool) -> None:
    """Print the fans and serial ports of this computer, with a configuration for each, and what is missing.

    Nothing is written to a device. write: a new file for the configuration; serial ports are left out of it, because
    their devices are only guessed. writable: the fans found take commands.

    Raises:
        UserError: the file cannot be written.
        typer.Exit: nothing can be watched.
    """
    shows_progress = not json_output and Console(stderr=True).is_terminal
    found: list[Found] = []
    for each in chain(discover_hwmon(root.absolute() if root != ROOT else root, writable=writable), discover_serial()):
        if shows_progress:
            typer.echo(f"{each.title} ...", err=True)
        found.append(each)
    lines = (line for each in found for line in _lines(each))
    show([asdict(each) | {"toml": each.toml} for each in found], *lines, json_output=json_output)
    if write:
        for line in _written(write, found):
            typer.echo(line, err=json_output)
    if not any(each.tray for each in found):
        raise typer.Exit(1)


def _lines(found: Found) -> list[str]:
    missing = found.missing or ("cannot be watched",)
    return [found.toml] if found.tray else [f"{found.kind}: {found.title}: {line}" for line in missing]


def _written(path: Path, found: Sequence[Found]) -> list[str]:
    """Write the hwmon chips into a new file. Returns lines that say what was done and what was left out.

    Raises:
        UserError: there is no chip to watch, or the file exists or cannot be written.
    """
    chips = [each for each in found if each.kind == "hwmon" and each.tray]
    if not chips:
        raise UserError(f"{path}: not written: no hwmon chip has a fan to watch")
    done = "written"
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write("\n".join(['site = "site"\n', *(each.toml for each in chips)]))
    except FileExistsError as error:
        if lacking := [str(each.tray["name"]) for each in chips if each.tray["name"] not in _trays_in(path)]:
            todo = f"paste the [[tray]] that it lacks ({', '.join(lacking)}), or name a new file"
            raise UserError(f"{path}: exists and was not changed: {todo}") from error
        done = "has all hwmon chips with fans already, not changed"
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}; name another file") from error
    guessed = "the device there is only guessed; paste its [[tray]] to watch it"
    why = [guessed if each.tray else next(iter(each.missing), "it cannot be watched") for each in found]
    left_out = [f"left out: {each.title}: {line}" for each, line in zip(found, why, strict=True) if each not in chips]
    return [*left_out, f"{done}: {path}; next: fantwin doctor -c {path}"]


def _trays_in(path: Path) -> set[str]:
    """The trays of a configuration; none if it cannot be read."""
    try:
        return {tray.name for tray in load_config(path, stages=()).trays}
    except UserError:
        return set()


def send_test_messages(config: Path, overrides: Sequence[str], targets: Sequence[str], *, json_output: bool) -> None:
    """Send a test message to the targets of the notifier, which need not be running. targets: names; empty for all.

    Raises:
        UserError: there is no such target, or one did not accept its message.
    """
    settings = load_config(config, overrides, stages=("notifier",))
    section = settings.sections["notifier"]
    assert isinstance(section, NotifierConfig)
    known = {target.name: target for target in section.target}
    if not known:
        raise UserError(f"{config}: no targets: add a table [[notifier.target]] with a name and url_file")
    if unknown := [name for name in targets if name not in known]:
        raise UsageError(f"{config}: no target {', '.join(unknown)}: there is {', '.join(known)}")

    place = Place(settings.site, section.page)
    failed: list[str] = []
    for name in targets or known:
        try:
            failure = send_test(known[name], settings.folder.joinpath, place)
            reason = failure.reason if failure else ""
        except UserError as error:
            reason = str(error)
        if reason:
            failed.append(name)
        line = f"{name}: {f'not delivered: {reason}' if reason else 'delivered'}"
        show({"target": name, "delivered": not reason, "reason": reason}, line, json_output=json_output)
    if failed:
        raise UserError(f"no test message for {', '.join(failed)}")
