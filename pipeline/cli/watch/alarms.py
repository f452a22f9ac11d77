"""`fantwin alarms`: list the current alarms, and acknowledge, shelve or suppress them."""

from __future__ import annotations

import getpass
import json
import os
import queue
import re
import threading
import time
from collections.abc import Callable, Iterable
from datetime import datetime
from enum import StrEnum
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from pipeline.bus.session import Bus, join_bus
from pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from pipeline.cli.watch.request import ask
from pipeline.config.loading import load_config
from pipeline.config.models import Config
from pipeline.config.roles import OPERATOR, roles_of
from pipeline.errors import UsageError, UserError
from pipeline.launch.judged_fans import JudgedChanges, JudgedFans, Unjudged, as_judged
from pipeline.launch.processes import process_list
from pipeline.launch.site_state import site_states
from pipeline.launch.site_watcher import SiteWatcher
from pipeline.launch.stage_notes import note_lines
from pipeline.runtime.signals import stop_on_signals
from schemas.codec import CodecError, decode
from schemas.enums import Action, Severity, Transition
from schemas.messages import Alarm, Diagnosis, Request, newest_t_ns
from schemas.topics import alive_key, tray_key
from schemas.units import NS_PER_S
from scoring.alarms.alarm_flags import is_listed, is_presented
from scoring.alarms.current_alarms import CurrentAlarm, clock, current_alarms, until, words_of
from scoring.diagnosis.shown_causes import CANNOT_TELL, CAUSES, MIN_PROBABILITY, with_share
from scoring.wear.slow_change import WEAR_HINT

_DISCOVERY_S = 5.0  # every stage sends several health messages in this time
_SCORES_S = 3.0  # a score of every tray arrives in this time
_POLL_S = 0.02
_WATCH_S = 0.2  # between two looks at the stages while no alarm comes
_SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400}
_STYLES = {Severity.NONE: "", Severity.WARNING: "yellow", Severity.ALARM: "bold red"}


class OperatorAction(StrEnum):
    """The actions, as they are typed."""

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
        """The action of the request message."""
        return Action.ACKNOWLEDGE if self is OperatorAction.ACK else Action[self.name]


def alarms(
    asked: Annotated[
        OperatorAction | None, typer.Argument(metavar="ACTION", help=f"{', '.join(OperatorAction)}.")
    ] = None,
    tray: Annotated[str | None, typer.Argument(help="The tray.")] = None,
    fan: Annotated[int | None, typer.Argument(help="The fan, counted from 0; all fans if omitted.")] = None,
    config: ConfigOption = DEFAULT_CONFIG,
    duration: Annotated[
        str | None, typer.Option("--for", metavar="TIME", help="How long to shelve: 90s, 30m, 8h or 2d.")
    ] = None,
    comment: Annotated[str, typer.Option(help="Comment for the record.")] = "",
    operator: Annotated[str | None, typer.Option(help="Name of the operator; default: your login name.")] = None,
    show_all: Annotated[bool, typer.Option("--all", help="Also list alarms that are over.")] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Keep running and print every transition.")] = False,
    timeout_s: Annotated[float, typer.Option("--timeout", metavar="S", help="How long to wait for answers.")] = 5.0,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """List the current alarms; or acknowledge, shelve or suppress the alarm of a fan (docs/reference/alarms.md).

    Exit code 0: the list was printed and every fan is judged now, or the request was granted; 1: a fan is not judged,
    or the request was refused or not answered.

    Example: fantwin alarms

    Example: fantwin alarms shelve tray1 3 --for 30m --comment "spare part ordered"
    """
    settings = load_config(config, overrides or (), stages=())
    stop = threading.Event()
    if asked is None:
        if duration or comment or operator:
            raise UsageError("--for, --comment and --operator need an action: fantwin alarms ack TRAY FAN")
        stop_on_signals(stop)
        with join_bus(settings, stop, listens=False) as bus:
            _list(bus, settings, stop, show_all=show_all, watch=watch, json_output=json_output)
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
    )
    stop_on_signals(stop)
    with join_bus(settings, stop, listens=False, roles=(OPERATOR,)) as bus:
        watcher = SiteWatcher(bus, settings.site, roles_of(settings))
        wait_for_stages(bus, watcher, settings, stop, tray=name)
        fans = set(range(settings.tray(name).fans)) if number < 0 else {number}
        answers = ask(bus, settings.site, name, request, fans, timeout_s, stop, watcher)
    _report(asked, name, answers, json_output)


def _list(bus: Bus, config: Config, stop: threading.Event, *, show_all: bool, watch: bool, json_output: bool) -> None:
    key = tray_key(config.site, "*", "alarm")
    news: queue.Queue[Alarm] = queue.Queue()
    bus.subscribe(key, lambda its_key, payload: _decoded(config.site, its_key, payload, news.put))
    watcher = SiteWatcher(bus, config.site, roles_of(config))
    judged = JudgedFans(bus, config.site, config.trays, watcher)
    wait_for_stages(bus, watcher, config, stop)
    known: list[Alarm] = []
    for its_key, payload in bus.recover(key):
        _decoded(config.site, its_key, payload, known.append)
    known = [alarm for alarm in known if _counts(watcher, config.site, alarm)]
    found = [each for each in current_alarms(sorted(known, key=newest_t_ns)) if show_all or is_listed(each.newest)]
    console = Console(soft_wrap=True, highlight=False)
    unjudged = _wait_until_judged(watcher, judged, config, stop)
    found = as_judged(found, unjudged)
    slow = _slow_changes(watcher)
    if json_output:
        shown = {"alarms": [each.as_json() for each in found], "not_judged": [each.as_json() for each in unjudged]}
        shown |= {"at_rest": [each.as_json() for each in judged.at_rest()], "slow_changes": slow}
        typer.echo(json.dumps(shown))
    else:
        now = judged.words_now()
        for each in found:
            console.print(alarm_lines(each, now.get((each.newest.header.tray, each.newest.fan), "")))
        lines = [Text(line, style="yellow") for line in slow] + [Text(each.line(), style="red") for each in unjudged]
        for line in lines:
            console.print(line)
        if not found and not unjudged:
            console.print(Text("no alarms", style="green"))
    if watch:
        changes = JudgedChanges(unjudged)

        def judged_changes() -> list[str]:
            return changes.lines(judged.unjudged(site_states(watcher, process_list(config))))

        listed = {_identity(alarm) for alarm in known}
        _watch(news, listed, watcher, config.site, judged_changes, stop, console, json_output=json_output)
    elif unjudged:
        raise typer.Exit(1)


def _watch(
    news: queue.Queue[Alarm],
    listed: set[tuple[str, int, str]],
    watcher: SiteWatcher,
    site: str,
    judged_changes: Callable[[], list[str]],
    stop: threading.Event,
    console: Console,
    *,
    json_output: bool,
) -> None:
    """Print each transition that is not listed already, which fans are judged now and were not, or the other way round,
    and when the last scorer goes or one is back."""
    has_scorer = True
    while not stop.is_set():
        try:
            alarm = news.get(timeout=_WATCH_S)
        except queue.Empty:
            if has_scorer != any(view.alive and view.health.stage == "scorer" for view in watcher.stages()):
                has_scorer = not has_scorer
                said = "a scorer is back" if has_scorer else "no scorer is alive: alarms are unknown until one is back"
                typer.echo(f"{datetime.now():%H:%M:%S}  site {site!r}: {said}", err=True)
            for line in judged_changes() if has_scorer else ():
                typer.echo(f"{datetime.now():%H:%M:%S}  {line}", err=True)
            continue
        if _identity(alarm) in listed or not _counts(watcher, site, alarm):
            continue
        if json_output:
            typer.echo(json.dumps({"transition": _word(alarm), **_alone(alarm).as_json()}))
        else:
            console.print(_transition_line(alarm))


def _identity(alarm: Alarm) -> tuple[str, int, str]:
    return alarm.header.producer, alarm.header.sequence, alarm.header.tray


def _slow_changes(watcher: SiteWatcher) -> list[str]:
    """What scorers say about fans that change slowly, which is no alarm yet."""
    notes = note_lines(view.health for view in watcher.stages() if view.alive)
    return [line for line in notes if line.endswith(WEAR_HINT)]


def _wait_until_judged(
    watcher: SiteWatcher, judged: JudgedFans, config: Config, stop: threading.Event
) -> list[Unjudged]:
    """The fans that are not judged now; waits for scores, which come in blocks."""
    until_s = time.monotonic() + _SCORES_S
    while True:
        unjudged = judged.unjudged(site_states(watcher, process_list(config)))
        if not unjudged or time.monotonic() > until_s or stop.wait(_POLL_S):
            return unjudged


def wait_for_stages(
    bus: Bus,
    watcher: SiteWatcher,
    config: Config,
    stop: threading.Event,
    what: str = "alarms",
    tray: str | None = None,
) -> None:
    """Wait until every stage that is alive has sent its health: requests and answers then reach all of them.

    tray: that must have a scorer; None: one of any tray is enough.

    Raises:
        UserError: no such scorer is alive.
    """
    until_s = time.monotonic() + _DISCOVERY_S
    scorer = alive_key(config.site, "scorer", "")
    while True:
        heard = {alive_key(config.site, view.health.stage, view.health.instance) for view in watcher.stages()}
        alive = bus.alive(alive_key(config.site, "*", "*"))
        if tray is None:
            scorers = {key for key in alive if key.startswith(scorer)}
        else:
            owner = watcher.owner("scorer", tray)
            scorers = alive & {scorer + owner.instance} if owner else set[str]()
        if scorers & heard and alive <= heard:
            return
        if time.monotonic() > until_s or stop.wait(_POLL_S):
            break
    if not scorers:
        has_others = any(key.startswith(scorer) for key in alive)
        of_tray = f" for tray {tray}" if tray and has_others else ""
        where = f"no scorer of site {config.site!r} answers at {config.bus.endpoint}{of_tray}"
        raise UserError(f"{what} unknown: {where}; is `fantwin up -c {config.path}` running?")


def _named(config: Config, asked: OperatorAction, tray: str | None, fan: int | None) -> tuple[int, str]:
    """The number of the fan, -1 for all, and the tray."""
    names = ", ".join(each.name for each in config.trays)
    if tray is None:
        raise UsageError(f"name a tray: fantwin alarms {asked} TRAY [FAN] (trays: {names})")
    fans = config.tray(tray).fans
    if fan is not None and not 0 <= fan < fans:
        raise UsageError(f"fan {fan}: tray {tray} has fans 0 to {fans - 1}")
    return -1 if fan is None else fan, tray


def _seconds(asked: OperatorAction, duration: str | None) -> float:
    if duration is None:
        return 0.0
    if asked is not OperatorAction.SHELVE:
        raise UsageError(f"--for can be used with shelve only, not with {asked}")
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd])", duration)
    if not match or float(match[1]) == 0:
        raise UsageError(f"--for {duration}: give a time such as 90s, 30m, 8h or 2d")
    return float(match[1]) * _SECONDS[match[2]]


def _login_name() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # the user of a container may have no name
        return f"user {os.getuid()}"


def _report(asked: OperatorAction, tray: str, answers: list[Alarm], json_output: bool) -> None:
    refused = [alarm for alarm in answers if alarm.transition == Transition.REFUSED]
    if json_output:
        rows = [
            {"fan": alarm.fan, "transition": _word(alarm), "message": alarm.message, **_alone(alarm).as_json()}
            for alarm in answers
        ]
        typer.echo(json.dumps({"tray": tray, "action": str(asked), "answers": rows}))
    else:
        for alarm in answers if len(answers) > 1 else set(answers) - set(refused):
            typer.echo(f"{tray}: {_granted(alarm)}")
    if len(refused) == len(answers):
        raise UserError(f"{tray}: {refused[0].message if len(refused) == 1 else f'{asked} refused for all fans'}")


def _granted(alarm: Alarm) -> str:
    return f"fan {alarm.fan}: shelved {until(alarm)}" if alarm.transition == Transition.SHELVED else alarm.message


def _decoded(site: str, key: str, payload: bytes, then: Callable[[Alarm], None]) -> None:
    """Unreadable messages, and those of another tray than their key says, are skipped; the stages count them."""
    try:
        alarm = decode(Alarm, payload)
    except CodecError:
        return
    assert isinstance(alarm, Alarm)
    if key == tray_key(site, alarm.header.tray, "alarm"):
        then(alarm)


def _counts(watcher: SiteWatcher, site: str, alarm: Alarm) -> bool:
    """Whether an alarm is one of the site, not of a stranger."""
    return watcher.counts(tray_key(site, alarm.header.tray, "alarm"), alarm.header.producer)


def _alone(alarm: Alarm) -> CurrentAlarm:
    """The alarm as this message alone describes it."""
    by = alarm.operator_name if alarm.acknowledged else ""
    return CurrentAlarm(alarm, alarm.message, alarm.causes, by, alarm.t_ns)


def _word(alarm: Alarm) -> str:
    return alarm.transition.name.lower()


def alarm_lines(current: CurrentAlarm, now: str = "") -> Text:
    """The alarm for people, in up to three lines: state, causes, message. now: what the fan does, if it is known."""
    alarm = current.newest
    by = f" by {current.acknowledged_by}" if current.acknowledged_by else ""
    words = [f"{word}{by}" if word == "acknowledged" else word for word in current.states()]
    words += [f"now {now}"] if now else []
    style = _STYLES.get(alarm.severity, "bold red") if is_presented(alarm) else "dim"
    text = Text.assemble((f"{_name(alarm)}  {alarm.severity.name:7}", style), f"  {', '.join(words)}")
    if alarm.severity != Severity.NONE:
        text.append(f"  since {clock(alarm.onset_t_ns)} ({_age(time.time_ns() - alarm.onset_t_ns)})")
    if current.causes:
        evidence = current.causes[0].evidence
        is_shown = not evidence or evidence in current.message
        why = "" if is_shown else f": {evidence.removeprefix(f'{CAUSES[CANNOT_TELL]}: ')}"
        text.append(f"\n    {_probable(current.causes)}{why}")
    if about := current.about():
        text.append(f"\n    {about}")
    return text


def _transition_line(alarm: Alarm) -> Text:
    by = f" by {alarm.operator_name}" if alarm.operator_name else ""
    why = f"  {_probable(alarm.causes)}" if alarm.causes else ""
    word = Text(
        f"{alarm.transition.name.replace('_', ' ')}{by}",
        style=_STYLES.get(alarm.severity, "bold red") if alarm.active else "",
    )
    return Text.assemble(
        f"{clock(alarm.t_ns)}  {_name(alarm)}  {alarm.severity.name:7}  ", word, f"{why}  {words_of(alarm)}"
    )


def _name(alarm: Alarm) -> str:
    return f"{alarm.header.tray} fan {alarm.fan}"


def _probable(causes: Iterable[Diagnosis]) -> str:
    """The most probable cause, and the others that are probable enough to be listed."""
    return ", ".join(
        with_share(each) for number, each in enumerate(causes) if not number or each.probability >= MIN_PROBABILITY
    )


def _age(age_ns: int) -> str:
    seconds = max(0, age_ns // NS_PER_S)
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds // size} {unit}"
    return f"{seconds} s"
