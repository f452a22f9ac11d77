"""`fantwin twins`: the versions of a learned twin; which is in force, the next one, what is never learned from."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterable, Sequence
from datetime import datetime
from enum import StrEnum
from functools import partial
from typing import Annotated, Any

import typer

from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.cli.progress import interruptible, working
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.settings import Config, TrayConfig
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.learning.child_command import VARIABLE
from fantwin.pipeline.learning.versions import (
    DECLARED_PER_DAY,
    Check,
    Drop,
    TwinVersions,
    Version,
    VersionList,
    learning_folder,
)
from fantwin.pipeline.recordings.dates import format_local
from fantwin.pipeline.runtime.signals import when_stdin_closes
from fantwin.schemas.fan_names import NO_NAMES, FanNames
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
        when_stdin_closes(partial(os.kill, os.getpid(), signal.SIGTERM))  # the stage that started it holds it open
    settings = load_config(config, overrides or (), stages=("learner",))
    of = learning_tray(settings, tray)
    if asked in (VersionAction.LEARN, VersionAction.CHECK):
        _learn(settings, of, only_if_changed=asked is VersionAction.CHECK, json_output=json_output)
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
    lines = [*said, *list_lines(listed, of.names)]
    if not listed.versions:
        lines.append(
            f"{of.name} has no twin yet: `fantwin up` makes the first; `fantwin status` says what it waits for"
        )
    show({"tray": of.name, **list_as_json(listed), "notes": said}, *lines, json_output=json_output)


def _learn(settings: Config, of: TrayConfig, *, only_if_changed: bool, json_output: bool) -> None:
    """Make the next version of the twin of a tray, and print it.

    Raises:
        UserError: none can be made, for example because of too little history.
        typer.Exit: Ctrl-C.
    """
    from fantwin.pipeline.learning.next_version import make_next_version  # noqa: PLC0415  loads scoring

    folder = learning_folder(settings.run_folder, of.name)
    doing = f"{'checking' if only_if_changed else 'learning'} the twin of {of.name}"
    with interruptible("no version was made"), working(doing) as say:
        version = make_next_version(folder, of.name, DECLARED_PER_DAY, say, of.names, only_if_changed=only_if_changed)
    listed = TwinVersions(folder, of.name).read()
    lines = [check_line(listed.check, of.names) if listed.check else NO_REFERENCE] if only_if_changed else []
    if version:
        lines += [*version_lines(version, listed), *offer_lines(listed)]
    elif listed.waiting:
        lines.append(f"no version was made: {listed.waiting.name} is offered already (fantwin twins)")
    made, last_check = version and version_as_json(version, listed), listed.check and check_as_json(listed.check)
    show({"version": made, "check": last_check}, *lines, json_output=json_output)


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
    stays = f"{was} was learned from that time span and stays in force: no version can replace it"
    return [replaced if now else f"{stays}; the next will not use that time span"]


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


NO_REFERENCE = (
    "no version was learned from 24 h of healthy running yet: there is no reference to check the fans against"
)


def list_lines(listed: VersionList, names: FanNames) -> list[str]:
    """A line for each version, more for the newest and for the one in force; an offer beside the one in force; faulty
    time spans; and the last check."""
    lines: list[str] = []
    for version in listed.versions:
        of_version = version_lines(version, listed)
        lines += of_version if version in (listed.current, listed.versions[-1]) else of_version[:1]
    marked = (f"marked as faulty: {format_local(first)} to {format_local(last)}" for first, last in listed.faulty)
    return [*lines, *offer_lines(listed), *marked, *([check_line(listed.check, names)] if listed.check else [])]


def list_as_json(listed: VersionList) -> dict[str, Any]:
    """The list. What has no reference yet names none."""
    return {
        **listed.model_dump(),
        "versions": [version_as_json(version, listed) for version in listed.versions],
        "check": listed.check and check_as_json(listed.check),
    }


def version_as_json(version: Version, listed: VersionList) -> dict[str, Any]:
    """One version of the list."""
    reference = listed.reference_of(version)
    return {**version.model_dump(), "reference": reference and reference.name}


def check_as_json(check: Check) -> dict[str, Any]:
    """A check of the fans."""
    return {**check.model_dump(), "reference": check.reference or None}


def check_line(check: Check, names: FanNames = NO_NAMES) -> str:
    """What the last check of the fans found."""
    if not check.reference:
        return NO_REFERENCE
    fans = [fan for fan, each in enumerate(check.change) if each is None]
    missing = (
        f"; {names.labels(fans)}: too few readings at commands that {check.reference} was trained on" if fans else ""
    )
    changes = f"speed of the fans since {check.reference}: {_percents(check.change)}{missing}"
    return f"checked up to {format_local(check.t_ns)}: {changes}"


def version_lines(version: Version, listed: VersionList) -> list[str]:
    """Lines about one version of the list."""
    not_used = "was offered" if version.outcome == "offered" else "not in force"
    not_used = "offered" if version == listed.waiting else not_used
    state = "IN FORCE" if version.name == listed.in_force else not_used
    unit = version.speed_unit
    return [
        f"{version.name}: {state}: {version.how}; "
        f"limits from {version.hours:.3g} h up to {format_local(version.made_t_ns)}",
        f"  why: {version.why}",
        f"  error {version.error:.3g} {unit}; {version.rate_text}",
        *(f"  {drop.line(unit)}" for drop in version.drops),
        f"  speed of the fans relative to the prediction of {version.reference}: {_percents(version.change)}",
    ]


def offer_lines(listed: VersionList) -> list[str]:
    """The version in force beside one that is offered, if there is one: which fits the fans as they are now?"""
    now, offered = listed.current, listed.waiting
    if now is None or offered is None:
        return []
    unit = offered.speed_unit
    error_before = "unknown" if offered.error_before is None else f"{offered.error_before:.3g} {unit}"
    rows = [
        ("", f"{now.name}, in force", f"{offered.name}, offered"),
        ("learned up to", format_local(now.made_t_ns), format_local(offered.made_t_ns)),
        ("error over the newest recording", error_before, f"{offered.error:.3g} {unit}"),
        ("limits from", f"{now.hours:.3g} h", f"{offered.hours:.3g} h"),
        *(
            ("drop found within a minute", _drop_of(before, unit), _drop_of(after, unit))
            for before, after in zip(now.drops, offered.drops, strict=False)
        ),
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    return ["", *("  " + "   ".join(map(str.ljust, row, widths)).rstrip() for row in rows), ""]


def _drop_of(drop: Drop, unit: str) -> str:
    found = "none" if drop.within_60_s is None else f"{drop.within_60_s:,.0f}"
    return f"{found} of {drop.speed:,.0f} {unit}"


def _percents(change: Iterable[float | None]) -> str:
    return ", ".join("not comparable" if each is None else f"{100 * each:+.1f} %" for each in change)
