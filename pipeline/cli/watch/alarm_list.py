"""The list of current alarms of `fantwin alarms`, and the transitions that `--watch` prints."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime

import typer
from rich.text import Text

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.cli.printing import duration_text, show
from fantwin.pipeline.cli.watch.scorers import wait_for_stages
from fantwin.pipeline.config.roles import roles_of
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import process_list
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.judging import JudgedChanges, Unjudged, as_judged, at_rest, unjudged
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.site.stage_notes import note_lines
from fantwin.schemas.enums import Severity
from fantwin.schemas.messages import Alarm, Diagnosis
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_flags import is_listed, is_presented
from fantwin.scoring.alarms.current_alarms import CurrentAlarm, clock, current_alarm
from fantwin.scoring.diagnosis.causes import CANNOT_TELL, CAUSES, MIN_PROBABILITY, with_share
from fantwin.scoring.wear.slow_change import is_of_slow_change

_SCORES_S = 3.0  # a score of every tray arrives in this time
_POLL_S = 0.02
_WATCH_S = 0.2  # between two looks at the stages while no alarm comes
_STYLES = {Severity.NONE: "", Severity.WARNING: "yellow", Severity.ALARM: "bold red"}


def show_list(
    bus: Bus, config: Config, stop: threading.Event, *, show_all: bool, watch: bool, json_output: bool
) -> None:
    """Print the list. watch: then print each transition until `stop`.

    Raises:
        UserError: no scorer is alive.
        typer.Exit: 1, a fan is not judged.
    """
    news: queue.Queue[Alarm] = queue.Queue()
    trays, roles = config.trays, roles_of(config)
    watcher = SiteWatcher(bus, config.site, roles, trays, has_scores=True, hear_alarm=news.put)
    wait_for_stages(bus, watcher, config, stop)
    watcher.ask_for_past_alarms()
    lacking = _wait_until_judged(watcher, config, stop)
    for _ in range(news.qsize()):
        news.get()
    found = [each for each in watcher.current_alarms() if show_all or is_listed(each.newest)]
    found = as_judged(found, lacking)
    slow = _slow_changes(watcher)
    shown = {"alarms": [each.as_json() for each in found], "not_judged": [each.as_json() for each in lacking]}
    shown |= {"at_rest": [each.as_json() for each in at_rest(watcher.model)], "slow_changes": slow}
    words_now = watcher.model.words_now([Fan(each.newest.header.tray, each.newest.fan) for each in found])
    lines = [alarm_lines(each, now) for each, now in zip(found, words_now, strict=True)]
    lines += [Text(line, style="yellow") for line in slow] + [Text(each.line(), style="red") for each in lacking]
    none = [] if found or lacking else [Text("no alarms", style="green")]
    show(shown, *lines, *none, json_output=json_output)
    if watch:
        _watch(news, watcher, config, JudgedChanges(lacking), stop, json_output=json_output)
    elif lacking:
        raise typer.Exit(1)


def _watch(
    news: queue.Queue[Alarm],
    watcher: SiteWatcher,
    config: Config,
    changes: JudgedChanges,
    stop: threading.Event,
    *,
    json_output: bool,
) -> None:
    """Print each transition, which fans are judged now and were not, or the other way round, and when the last scorer
    goes or one is back."""
    has_scorer = True
    while not stop.is_set():
        try:
            alarm = news.get(timeout=_WATCH_S)
        except queue.Empty:
            if has_scorer != any(view.alive and view.health.stage == "scorer" for view in watcher.stages()):
                has_scorer = not has_scorer
                said = "a scorer is back" if has_scorer else "no scorer is alive: alarms are unknown until one is back"
                typer.echo(f"{datetime.now():%H:%M:%S}  site {config.site!r}: {said}", err=True)
            lacking = unjudged(watcher.model, watcher.states(process_list(config))) if has_scorer else []
            for line in changes.lines(lacking) if has_scorer else ():
                typer.echo(f"{datetime.now():%H:%M:%S}  {line}", err=True)
            continue
        found = {"transition": word(alarm), **current_alarm([alarm]).as_json()}
        show(found, _transition_line(alarm), json_output=json_output)


def _slow_changes(watcher: SiteWatcher) -> list[str]:
    """What scorers say about fans that change slowly, which is no alarm yet."""
    healths = (view.health for view in watcher.stages() if view.alive)
    return note_lines(
        replace(health, notes=tuple(note for note in health.notes if is_of_slow_change(note.text)))
        for health in healths
    )


def _wait_until_judged(watcher: SiteWatcher, config: Config, stop: threading.Event) -> list[Unjudged]:
    """The fans that are not judged now; waits for scores, which come in blocks."""
    until_s = time.monotonic() + _SCORES_S
    while True:
        lacking = unjudged(watcher.model, watcher.states(process_list(config)))
        if not lacking or time.monotonic() > until_s or stop.wait(_POLL_S):
            return lacking


def word(alarm: Alarm) -> str:
    """The transition, for machines."""
    return alarm.transition.name.lower()


def alarm_lines(current: CurrentAlarm, now: str = "") -> Text:
    """The alarm for people, in up to three lines: state, causes, message. now: what the fan does, if it is known."""
    alarm = current.newest
    by = f" by {current.acknowledged_by}" if current.acknowledged_by else ""
    words = [f"{word}{by}" if word == "acknowledged" else word for word in current.states()]
    words += [f"now {now}"] if now else []
    style = _STYLES.get(alarm.severity, "bold red") if is_presented(alarm) else "dim"
    text = Text.assemble((f"{name_of(alarm)}  {alarm.severity.name:7}", style), f"  {', '.join(words)}")
    if alarm.severity != Severity.NONE:
        text.append(
            f"  since {clock(alarm.onset_t_ns)} ({duration_text(max(0, time.time_ns() - alarm.onset_t_ns) / NS_PER_S)})"
        )
    if current.causes:
        evidence = current.causes[0].evidence
        is_shown = not evidence or evidence in current.message
        why = "" if is_shown else f": {evidence.removeprefix(f'{CAUSES[CANNOT_TELL]}: ')}"
        text.append(f"\n    {probable(current.causes)}{why}")
    if about := current.about():
        text.append(f"\n    {about}")
    return text


def _transition_line(alarm: Alarm) -> Text:
    by = f" by {alarm.operator_name}" if alarm.operator_name else ""
    why = f"  {probable(alarm.causes)}" if alarm.causes else ""
    word = Text(
        f"{alarm.transition.name.replace('_', ' ')}{by}",
        style=_STYLES.get(alarm.severity, "bold red") if alarm.active else "",
    )
    return Text.assemble(
        f"{clock(alarm.t_ns)}  {name_of(alarm)}  {alarm.severity.name:7}  ", word, f"{why}  {alarm.message}"
    )


def name_of(alarm: Alarm) -> str:
    """The fan, for people."""
    return f"{alarm.header.tray} fan {alarm.fan}"


def probable(causes: Iterable[Diagnosis]) -> str:
    """The most probable cause, and the others that are probable enough to be listed."""
    return ", ".join(
        with_share(each) for number, each in enumerate(causes) if not number or each.probability >= MIN_PROBABILITY
    )
