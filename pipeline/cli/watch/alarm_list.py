"""The lists of `fantwin alarms`: current alarms, their transitions with `--watch`, and with `--history` past alarms and
the rate of false alarms.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

import numpy as np
import typer
from rich.text import Text

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.cli.printing import duration_text, show
from fantwin.pipeline.cli.progress import working
from fantwin.pipeline.cli.watch.scorers import wait_for_stages
from fantwin.pipeline.config.roles import roles_of
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import own_file, process_list, shards_of
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.clips.clip import require_no_clip
from fantwin.pipeline.recordings.dates import format_local
from fantwin.pipeline.recordings.indexed import rare_messages
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.recordings.run_recordings import recorded_files
from fantwin.pipeline.replay.offline.alarm_episodes import Episode, alarms_in, episodes
from fantwin.pipeline.site.alarm_history import FILE, AlarmHistory
from fantwin.pipeline.site.alarm_rates import AlarmRates
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.judging import JudgedChanges, Unjudged, as_judged, at_rest, unjudged
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.site.stage_states import note_lines
from fantwin.schemas.codec import CodecError, decode
from fantwin.schemas.enums import Feedback, Severity
from fantwin.schemas.messages import Alarm, Diagnosis, ModelCard, Score
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import is_listed, is_presented
from fantwin.scoring.alarms.current_alarms import CurrentAlarm, clock, current_alarm
from fantwin.scoring.calibration.calibration import ObservedRate, declared_per_day, together
from fantwin.scoring.diagnosis.causes import CANNOT_TELL, CAUSES, MIN_PROBABILITY, with_share
from fantwin.scoring.wear.slow_change import is_of_slow_change

_SCORES_S = 3.0  # a score of every tray arrives in this time
_POLL_S = 0.02
_WATCH_S = 0.2  # between two looks at the stages while no alarm comes
NS_PER_HOUR = 3600 * NS_PER_S
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


@dataclass
class _Tray:
    """What is known of a tray. judged_ns: summed over fans."""

    judged_ns: int = 0
    since_t_ns: int = 0
    declared_per_day: float | None = None


@dataclass
class _Past:
    """Alarms, their rates by tray, and what is not known."""

    alarms: list[Episode]
    rates: dict[str, ObservedRate]
    notes: list[str] = field(default_factory=list)


def show_history(recordings: Sequence[Path], config: Config | None, *, json_output: bool) -> None:
    """Print the alarms of recordings, or, without any, those that the gateway keeps on this host.

    Raises:
        UserError: a recording cannot be read, or there is no gateway's file.
    """
    if recordings:
        with working(f"reading {', '.join(map(str, recordings))}"):
            past = _recorded(recorded_files(recordings))
    else:
        assert config is not None
        past = _kept_by_gateway(config)
    rates = list(past.rates.values())
    found = {"alarms": [each.as_json() for each in past.alarms], "notes": past.notes}
    found |= {"rates": {tray: rate.as_json() for tray, rate in past.rates.items()}, "rate": together(rates).as_json()}
    named = list(past.rates.items()) + ([("together", together(rates))] if len(rates) > 1 else [])
    lines = [_line(each) for each in past.alarms] or [Text("no alarms", style="green")]
    lines += [Text(f"{name}: {_dated(rate)}") for name, rate in named]
    lines += [Text(note, style="yellow") for note in past.notes]
    show(found, *lines, json_output=json_output)


def _dated(rate: ObservedRate) -> str:
    since = f"since {format_local(rate.since_t_ns)}: " if rate.since_t_ns else ""
    return f"{since}{rate.text}"


def _line(alarm: Episode) -> Text:
    """One alarm, for people."""
    length_s = None if alarm.cleared_ns is None else (alarm.cleared_ns - alarm.onset_ns) / NS_PER_S
    lasted = "not over" if length_s is None else f"for {duration_text(length_s)}"
    cause = f"  {with_share(alarm.causes[0])}" if alarm.causes else ""
    by = f" by {alarm.feedback_by}" if alarm.feedback_by else ""
    reason = f": {alarm.feedback_reason}" if alarm.feedback_reason else ""
    said = "not marked" if alarm.feedback == Feedback.NONE else f"{alarm.feedback.words}{by}{reason}"
    return Text.assemble(
        f"{format_local(alarm.onset_ns)}  {alarm.tray} fan {alarm.fan}  ",
        (f"{alarm.severity.upper():7}", _STYLES[Severity[alarm.severity.upper()]]),
        f"  {lasted}{cause}  ",
        (said, "" if alarm.feedback == Feedback.NONE else "bold"),
    )


def _recorded(paths: Sequence[Path]) -> _Past:
    trays: dict[str, _Tray] = {}
    alarms: dict[tuple[str, str, int], Alarm] = {}
    without_scores: list[Path] = []
    newest: dict[tuple[str, str], int] = {}
    for path in _in_order(paths):
        require_no_clip(path, "and a rate from clips says nothing")
        for _, alarm in alarms_in(path):
            alarms[alarm.header.producer, alarm.header.tray, alarm.header.sequence] = alarm
        for envelope in rare_messages(path, "twin"):
            card = envelope.message
            if isinstance(card, ModelCard):
                trays.setdefault(card.header.tray, _Tray()).declared_per_day = declared_per_day(card.card_json)
        if "score" in read_metadata(path).left_out:
            without_scores.append(path)
        for envelope in read_recording(path, ("score",)).undecoded():
            _add_score(envelope.payload, trays, newest)
    notes = [
        f"{path}: the recorder has left out the scores, so how long fans were judged is not known"
        for path in without_scores
    ]
    return _with_rates(episodes(alarms.values()), trays, notes)


def _in_order(paths: Iterable[Path]) -> list[Path]:
    """By their first scores, so that what two of them have counts once."""

    def first_ns(path: Path) -> int:
        first = next(iter(read_recording(path, ("score",)).undecoded()), None)
        return first.received_t_ns if first else 0

    return sorted(paths, key=first_ns)


def _add_score(payload: bytes, trays: dict[str, _Tray], newest: dict[tuple[str, str], int]) -> None:
    """newest: by producer and tray, the sequence of the newest score: another recorder may have it, too."""
    try:
        score = decode(Score, payload, ("valid",))
    except CodecError:
        return
    tray = trays.setdefault(score.header.tray, _Tray())
    stream = (score.header.producer, score.header.tray)
    if score.header.sequence <= newest.get(stream, -1) or not len(score.t_ns):
        return
    newest[stream] = score.header.sequence
    first_t_ns = int(score.t_ns[0])
    tray.since_t_ns = min(tray.since_t_ns, first_t_ns) if tray.since_t_ns else first_t_ns
    tray.judged_ns += score.period_ns * int(np.count_nonzero(score.valid))


def _with_rates(alarms: Sequence[Episode], trays: dict[str, _Tray], notes: list[str]) -> _Past:
    for alarm in alarms:
        trays.setdefault(alarm.tray, _Tray())
    rates = {
        name: ObservedRate(
            since_t_ns=tray.since_t_ns,
            fan_hours=tray.judged_ns / NS_PER_HOUR,
            false_alarms=_count(alarms, name, Feedback.FALSE_ALARM),
            true_alarms=_count(alarms, name, Feedback.TRUE_ALARM),
            unmarked=_count(alarms, name, Feedback.NONE),
            declared_per_day=tray.declared_per_day,
        )
        for name, tray in sorted(trays.items())
    }
    return _Past(list(alarms), rates, notes)


def _count(alarms: Iterable[Episode], tray: str, feedback: Feedback) -> int:
    return sum(each.tray == tray and each.feedback == feedback for each in alarms)


def _kept_by_gateway(config: Config) -> _Past:
    """From the files of the gateway's processes in the run folder.

    Raises:
        UserError: there is none, or one cannot be read.
    """
    files = [config.run_folder / own_file(shard.name, FILE) for shard in shards_of("gateway", config)]
    present = [file for file in files if file.exists()]
    if not present:
        raise UserError(
            f"{files[0]}: no gateway has kept a history of alarms there; take it from recordings: "
            "fantwin alarms --history --recordings FILE..."
        )
    alarms: list[Alarm] = []
    rates: dict[str, ObservedRate] = {}
    for file in present:
        alarms += [alarm for _, alarm in alarms_in(file)]
        kept = AlarmHistory(file, read_only=True)
        try:
            rates |= AlarmRates(kept).observed()
        finally:
            kept.close()
    return _Past(episodes(alarms), rates)
