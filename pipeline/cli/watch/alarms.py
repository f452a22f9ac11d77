"""`fantwin alarms`: which alarms stand, and what an operator has to say to them."""

from __future__ import annotations

import getpass
import json
import os
import queue
import re
import threading
import time
from collections.abc import Callable, Iterable
from enum import StrEnum
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from pipeline.bus.session import Bus
from pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from pipeline.cli.watch.request import ask
from pipeline.config.loading import load_config
from pipeline.config.models import Config
from pipeline.errors import UserError
from pipeline.launch.watcher import Watcher
from pipeline.runtime.signals import stop_on_signals
from schemas.codec import CodecError, decode
from schemas.messages import Action, Alarm, Diagnosis, Request, Severity, Transition, newest_t_ns
from schemas.topics import alive_key, tray_key
from scoring.alarms.alarm_flags import is_listed, is_presented
from scoring.alarms.alarm_text import CANNOT_TELL, CAUSES
from scoring.alarms.current_alarms import CurrentAlarm, clock, current_alarms, until

_MEET_S = 5.0  # several healths of every stage
_LOOK_S = 0.02
_WORTH_NAMING = 0.05  # probability of a cause
_SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400}
_STYLES = {Severity.NONE: "", Severity.WARNING: "yellow", Severity.ALARM: "bold red"}


class Asked(StrEnum):
    """What may be asked for, as it is typed."""

    ACK = "ack"
    CONFIRM = "confirm"
    RESET = "reset"
    SHELVE = "shelve"
    UNSHELVE = "unshelve"
    SUPPRESS = "suppress"
    UNSUPPRESS = "unsuppress"
    OUT_OF_SERVICE = "out-of-service"
    IN_SERVICE = "in-service"
    COMMISSION = "commission"

    @property
    def action(self) -> Action:
        """The same on the bus."""
        return Action.ACKNOWLEDGE if self is Asked.ACK else Action[self.name]


def alarms(
    asked: Annotated[Asked | None, typer.Argument(metavar="ACTION", help=f"{', '.join(Asked)}.")] = None,
    tray: Annotated[str | None, typer.Argument(help="Of which tray.")] = None,
    fan: Annotated[int | None, typer.Argument(help="Of which fan, counted from 0; without it: of all.")] = None,
    config: ConfigOption = DEFAULT_CONFIG,
    duration: Annotated[
        str | None, typer.Option("--for", metavar="TIME", help="How long to shelve, as 90s, 30m, 8h or 2d.")
    ] = None,
    comment: Annotated[str, typer.Option(help="What the record should say.")] = "",
    operator: Annotated[str | None, typer.Option(help="Who asks; the login name where it is not given.")] = None,
    show_all: Annotated[bool, typer.Option("--all", help="List those that are over, too.")] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Go on, and print what happens to alarms.")] = False,
    timeout_s: Annotated[float, typer.Option("--timeout", metavar="S", help="Wait so long for answers.")] = 5.0,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """List the alarms that stand, or acknowledge, shelve ... the alarm of a fan (docs/reference/alarms.md).

    Exit code 0: listed, or granted; 1: refused, or nobody answered.

    Example: fantwin alarms

    Example: fantwin alarms shelve tray1 3 --for 30m --comment "spare part ordered"
    """
    settings = load_config(config, overrides or (), stages=())
    stop = threading.Event()
    if asked is None:
        if duration or comment or operator:
            raise UserError("--for, --comment and --operator go with an action: fantwin alarms ack TRAY FAN")
        stop_on_signals(stop)
        with Bus(settings.bus, stop, listens=False) as bus:
            _list(bus, settings, stop, show_all=show_all, watch=watch, json_output=json_output)
        return
    if show_all or watch:
        raise UserError(f"--all and --watch are for the list: leave them out with {asked}")
    number, name = _named(settings, asked, tray, fan)
    request = Request(
        t_ns=time.time_ns(),
        action=asked.action,
        fan=number,
        duration_s=_seconds(asked, duration),
        operator_name=operator or _login_name(),
        comment=comment,
    )
    stop_on_signals(stop)
    with Bus(settings.bus, stop, listens=False) as bus:
        meet(bus, Watcher(bus, settings.site), settings, stop)
        fans = set(range(settings.tray(name).fans)) if number < 0 else {number}
        answers = ask(bus, settings.site, name, request, fans, timeout_s, stop)
    _report(asked, name, answers, json_output)


def _list(bus: Bus, config: Config, stop: threading.Event, *, show_all: bool, watch: bool, json_output: bool) -> None:
    key = tray_key(config.site, "*", "alarm")
    news: queue.Queue[Alarm] = queue.Queue()
    bus.subscribe(key, lambda _key, payload: _decoded(payload, news.put))
    meet(bus, Watcher(bus, config.site), config, stop)
    known: list[Alarm] = []
    for _, payload in bus.recover(key, "*", 0, 2**63, lambda: time.sleep(_LOOK_S)):
        _decoded(payload, known.append)
    found = [each for each in current_alarms(sorted(known, key=newest_t_ns)) if show_all or is_listed(each.newest)]
    console = Console(soft_wrap=True, highlight=False)
    if json_output:
        typer.echo(json.dumps({"alarms": [each.as_json() for each in found]}))
    else:
        for each in found:
            console.print(standing_lines(each))
        if not found:
            console.print(Text("no alarms", style="green"))
    names = {(alarm.header.producer, alarm.header.sequence, alarm.header.tray) for alarm in known}
    while watch and not stop.is_set():
        try:
            alarm = news.get(timeout=0.1)
        except queue.Empty:
            continue
        if (alarm.header.producer, alarm.header.sequence, alarm.header.tray) in names:
            continue
        if json_output:
            typer.echo(json.dumps({"transition": _word(alarm), **_alone(alarm).as_json()}))
        else:
            console.print(_happened_line(alarm))


def meet(bus: Bus, watcher: Watcher, config: Config, stop: threading.Event, what: str = "alarms") -> None:
    """Wait until all stages that are there have been heard of: what is asked, or said, then reaches each of them.

    Raises:
        UserError: no scorer is among them.
    """
    until_s = time.monotonic() + _MEET_S
    scorer = alive_key(config.site, "scorer", "all")
    while True:
        heard = {alive_key(config.site, view.health.stage, view.health.instance) for view in watcher.stages()}
        alive = bus.alive(alive_key(config.site, "*", "*"))
        if scorer in alive & heard and alive <= heard:
            return
        if time.monotonic() > until_s or stop.wait(_LOOK_S):
            break
    if scorer not in alive:
        where = f"no scorer of site {config.site!r} answers at {config.bus.endpoint}"
        raise UserError(f"{what} unknown: {where}; is `fantwin up -c {config.path}` running?")


def _named(config: Config, asked: Asked, tray: str | None, fan: int | None) -> tuple[int, str]:
    """The number of the fan, -1 for all, and the tray."""
    names = ", ".join(each.name for each in config.trays)
    if tray is None:
        raise UserError(f"say of which tray: fantwin alarms {asked} TRAY [FAN] (of {names})")
    fans = config.tray(tray).fans
    if fan is not None and not 0 <= fan < fans:
        raise UserError(f"fan {fan}: tray {tray} has fans 0 to {fans - 1}")
    return -1 if fan is None else fan, tray


def _seconds(asked: Asked, duration: str | None) -> float:
    if duration is None:
        return 0.0
    if asked is not Asked.SHELVE:
        raise UserError(f"--for goes with shelve, and not with {asked}")
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd])", duration)
    if not match or float(match[1]) == 0:
        raise UserError(f"--for {duration}: give a time such as 90s, 30m, 8h or 2d")
    return float(match[1]) * _SECONDS[match[2]]


def _login_name() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container's user need not have a name
        return f"user {os.getuid()}"


def _report(asked: Asked, tray: str, answers: list[Alarm], json_output: bool) -> None:
    refused = [alarm for alarm in answers if alarm.transition == Transition.REFUSED]
    if json_output:
        said = [
            {"fan": alarm.fan, "transition": _word(alarm), "message": alarm.message, **_alone(alarm).as_json()}
            for alarm in answers
        ]
        typer.echo(json.dumps({"tray": tray, "action": str(asked), "answers": said}))
    else:
        for alarm in answers if len(answers) > 1 else set(answers) - set(refused):
            typer.echo(f"{tray}: {_granted(alarm)}")
    if len(refused) == len(answers):
        raise UserError(f"{tray}: {refused[0].message if len(refused) == 1 else f'{asked} refused for all fans'}")


def _granted(alarm: Alarm) -> str:
    return f"fan {alarm.fan}: shelved {until(alarm)}" if alarm.transition == Transition.SHELVED else alarm.message


def _decoded(payload: bytes, then: Callable[[Alarm], None]) -> None:
    """An onlooker judges nobody: what it cannot read, the stages count."""
    try:
        alarm = decode(Alarm, payload)
    except CodecError:
        return
    assert isinstance(alarm, Alarm)
    then(alarm)


def _alone(alarm: Alarm) -> CurrentAlarm:
    """What this message alone says."""
    return CurrentAlarm(alarm, alarm.message, alarm.causes, alarm.operator_name if alarm.acknowledged else "")


def _word(alarm: Alarm) -> str:
    return alarm.transition.name.lower()


def standing_lines(standing: CurrentAlarm) -> Text:
    """How an alarm stands, for people: two lines or three."""
    alarm = standing.newest
    by = f" by {standing.acknowledged_by}" if standing.acknowledged_by else ""
    words = [f"{word}{by}" if word == "acknowledged" else word for word in standing.states()]
    style = _STYLES.get(alarm.severity, "bold red") if is_presented(alarm) else "dim"
    text = Text.assemble((f"{_name(alarm)}  {alarm.severity.name:7}", style), f"  {', '.join(words)}")
    if alarm.severity != Severity.NONE:
        text.append(f"  since {clock(alarm.onset_t_ns)} ({_age(time.time_ns() - alarm.onset_t_ns)})")
    if standing.causes:
        evidence = standing.causes[0].evidence
        told = not evidence or evidence in standing.message
        why = "" if told else f": {evidence.removeprefix(f'{CAUSES[CANNOT_TELL]}: ')}"
        text.append(f"\n    {_probable(standing.causes)}{why}")
    if standing.message:
        text.append(f"\n    {standing.message}")
    return text


def _happened_line(alarm: Alarm) -> Text:
    by = f" by {alarm.operator_name}" if alarm.operator_name else ""
    why = f"  {_probable(alarm.causes)}" if alarm.causes else ""
    word = Text(
        f"{alarm.transition.name.replace('_', ' ')}{by}",
        style=_STYLES.get(alarm.severity, "bold red") if alarm.active else "",
    )
    return Text.assemble(
        f"{clock(alarm.t_ns)}  {_name(alarm)}  {alarm.severity.name:7}  ", word, f"{why}  {alarm.message}"
    )


def _name(alarm: Alarm) -> str:
    return f"{alarm.header.tray} fan {alarm.fan}"


def _probable(causes: Iterable[Diagnosis]) -> str:
    """The causes that are not all but excluded, the most probable first."""
    return ", ".join(
        f"{each.cause} {100 * each.probability:.0f} %" for each in causes if each.probability >= _WORTH_NAMING
    )


def _age(age_ns: int) -> str:
    seconds = max(0, age_ns // 1_000_000_000)
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds // size} {unit}"
    return f"{seconds} s"
