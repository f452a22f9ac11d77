"""`fantwin alarms`: list the current alarms, acknowledge or shelve them, and say whether they were true."""

from __future__ import annotations

import getpass
import os
import re
import time
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from fantwin.pipeline.bus.session import join_bus
from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.cli.watch.alarm_list import show_history, show_list, word
from fantwin.pipeline.cli.watch.scorers import ask, wait_for_stages
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.roles import OPERATOR, roles_of
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.recordings.remote import matching, recording_path
from fantwin.pipeline.runtime.signals import stop_on_signals
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.enums import Action, Transition
from fantwin.schemas.messages import Alarm, Request
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import GIVES_FEEDBACK
from fantwin.scoring.alarms.current_alarms import current_alarm, until

_SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400}


class OperatorAction(StrEnum):
    """The actions, as they are typed."""

    ACKNOWLEDGE = "acknowledge"
    SHELVE = "shelve"
    UNSHELVE = "unshelve"
    OUT_OF_SERVICE = "out-of-service"
    IN_SERVICE = "in-service"
    COMMISSION = "commission"
    TRUE_ALARM = "true-alarm"
    FALSE_ALARM = "false-alarm"
    COMMENT = "comment"

    @property
    def action(self) -> Action:
        """The action of the request message."""
        return Action[self.name]


def alarms(
    asked: Annotated[
        OperatorAction | None, typer.Argument(metavar="ACTION", help=f"{', '.join(OperatorAction)}.")
    ] = None,
    tray: Annotated[str | None, typer.Argument(help="The tray.")] = None,
    fan: Annotated[
        str | None, typer.Argument(help="The fan: its name, or its number, counted from 0; all fans if omitted.")
    ] = None,
    config: ConfigOption = DEFAULT_CONFIG,
    duration: Annotated[
        str | None, typer.Option("--for", metavar="TIME", help="How long to shelve: 90s, 30m, 8h or 2d.")
    ] = None,
    comment: Annotated[str, typer.Option(help="Comment for the record; for false-alarm, why it was false.")] = "",
    onset: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="For true-alarm and false-alarm: the start of the alarm, as shown in the list and the history: "
            "[YYYY-MM-DD ]HH:MM:SS. If omitted: the fan's last alarm.",
        ),
    ] = None,
    operator: Annotated[str | None, typer.Option(help="Name of the operator; default: your login name.")] = None,
    show_all: Annotated[bool, typer.Option("--all", help="Also list alarms that have cleared.")] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Keep running and print every transition.")] = False,
    history: Annotated[
        bool,
        typer.Option(
            "--history",
            help="List past alarms with the operators' feedback, and compare the rate of false alarms with the "
            "declared rate. The data come from the gateway's file on this host, or from --recordings.",
        ),
    ] = False,
    recordings: Annotated[
        list[Path] | None,
        typer.Option(
            parser=recording_path,
            callback=matching,
            metavar="FILE...",
            help="With --history: read the alarms from these recordings (all arguments up to the next option).",
        ),
    ] = None,
    timeout_s: Annotated[float, typer.Option("--timeout", metavar="S", help="How long to wait for answers.")] = 5.0,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """List the current alarms; acknowledge or shelve the alarm of a fan, or say whether it was true
    (docs/reference/alarms.md).

    Exit code 0: the list was printed and every fan is judged now, or the request was granted; 1: a fan is not judged,
    or the request was refused or not answered.

    Example: fantwin alarms

    Example: fantwin alarms shelve tray1 3 --for 30m --comment "spare part ordered"

    Example: fantwin alarms false-alarm tray1 3 --comment "the door was open"

    Example: fantwin alarms --history --recordings runs/*.mcap
    """
    if recordings and not history:
        raise UsageError("--recordings needs --history: fantwin alarms --history --recordings FILE...")
    if history and (asked or show_all or watch or duration or comment or operator or onset):
        raise UsageError("--history only lists: of the other options it takes --recordings and --json")
    settings = None if recordings else load_config(config, overrides or (), stages=())
    if history or settings is None:
        show_history(recordings or (), settings, json_output=json_output)
        return
    if asked is None and (duration or comment or operator or onset):
        raise UsageError("--for, --comment, --operator and --onset need an action: fantwin alarms acknowledge TRAY FAN")
    if asked is None:
        stop = stop_on_signals()
        with join_bus(settings, listens=False) as bus:
            show_list(bus, settings, stop, show_all=show_all, watch=watch, json_output=json_output)
        return
    if show_all or watch:
        raise UsageError(f"--all and --watch apply to the list only: leave them out with {asked}")
    number, name = _named(settings, asked, tray, fan)
    request = Request(
        t_ns=time.time_ns(),
        action=asked.action,
        fan=number,
        duration_s=_seconds(asked, duration),
        operator_name=operator or _login_name(),
        comment=comment,
        onset_t_ns=_onset_t_ns(asked, onset),
    )
    stop = stop_on_signals()
    with join_bus(settings, listens=False, roles=(OPERATOR,)) as bus:
        watcher = SiteWatcher(bus, settings.site, roles_of(settings))
        wait_for_stages(bus, watcher, settings, stop, tray=name)
        of = settings.tray(name)
        fans = set(range(of.fans)) if number < 0 else {number}
        answers = ask(bus, settings.site, name, request, fans, timeout_s, stop, watcher, of.names)
    _report(asked, name, answers, json_output)


def _named(config: Config, asked: OperatorAction, tray: str | None, fan: str | None) -> tuple[int, str]:
    """The number of the fan, -1 for all, and the tray."""
    names = ", ".join(each.name for each in config.trays)
    if tray is None:
        raise UsageError(f"name a tray: fantwin alarms {asked} TRAY [FAN] (trays: {names})")
    chosen = config.tray(tray)
    return -1 if fan is None else chosen.fan_called(fan), tray


def _seconds(asked: OperatorAction, duration: str | None) -> float:
    if duration is None:
        return 0.0
    if asked is not OperatorAction.SHELVE:
        raise UsageError(f"--for can be used with shelve only, not with {asked}")
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd])", duration)
    if not match or float(match[1]) == 0:
        raise UsageError(f"--for {duration}: give a time such as 90s, 30m, 8h or 2d")
    return float(match[1]) * _SECONDS[match[2]]


def _onset_t_ns(asked: OperatorAction, onset: str | None) -> int:
    """In the middle of the second that was typed, which is enough to name an alarm; 0: the last one."""
    if onset is None:
        return 0
    if asked.action not in GIVES_FEEDBACK:
        raise UsageError(f"--onset can be used with true-alarm and false-alarm only, not with {asked}")
    text = onset if " " in onset or "T" in onset else f"{datetime.now():%Y-%m-%d} {onset}"
    try:
        return round(datetime.fromisoformat(text).timestamp() * NS_PER_S) + NS_PER_S // 2
    except ValueError as error:
        raise UsageError(f"--onset {onset}: give a time such as 14:03:10 or '2026-01-31 14:03:10'") from error


def _login_name() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # the user of a container may have no name
        return f"user {os.getuid()}"


def _report(asked: OperatorAction, tray: str, answers: list[Alarm], json_output: bool) -> None:
    refused = [alarm for alarm in answers if alarm.transition == Transition.REFUSED]
    rows = [
        {"fan": alarm.fan, "transition": word(alarm), "message": alarm.message, **current_alarm([alarm]).as_json()}
        | {"marked_onset_t_ns": alarm.marked_onset_t_ns}
        for alarm in answers
    ]
    shown = answers if len(answers) > 1 else set(answers) - set(refused)
    lines = (f"{tray}: {_granted(alarm)}" for alarm in shown)
    show({"tray": tray, "action": str(asked), "answers": rows}, *lines, json_output=json_output)
    if len(refused) == len(answers):
        raise UserError(f"{tray}: {refused[0].message if len(refused) == 1 else f'{asked} refused for all fans'}")


def _granted(alarm: Alarm) -> str:
    return f"{alarm.label}: shelved {until(alarm)}" if alarm.transition == Transition.SHELVED else alarm.message
