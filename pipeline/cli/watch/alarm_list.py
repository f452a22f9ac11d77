"""The lists of `fantwin alarms`: current alarms, their transitions with `--watch`, and with `--history` past alarms and
the rate of false alarms.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np
import typer
from rich.text import Text

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.cli.printing import STYLES, duration_text, show
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
from fantwin.pipeline.site.judging import JudgedChanges, as_judged, at_rest, unjudged
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.site.stage_states import note_lines
from fantwin.schemas.codec import CodecError, decode
from fantwin.schemas.enums import Feedback, Severity
from fantwin.schemas.messages import Alarm, Diagnosis, ModelCard, Score
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import is_listed, is_presented
from fantwin.scoring.alarms.current_alarms import CurrentAlarm, clock, current_alarm
from fantwin.scoring.calibration.calibration import ObservedRate, declared_per_day, together
from fantwin.scoring.diagnosis.causes import CANNOT_TELL, CAUSES, MIN_PROBABILITY, most_probable, with_share
from fantwin.scoring.wear.slow_change import is_of_slow_change

_SCORES_S = 3.0  # a score of every tray arrives in this time
_POLL_S = 0.02
_WATCH_S = 0.2  # between two looks at the stages while no alarm comes
NS_PER_HOUR = 3600 * NS_PER_S


def show_list(
    bus: Bus, config: Config, stop: threading.Event, *, show_all: bool, watch: bool, json_output: bool
) -> None:
    """Print the list. watch: then print each transition until `stop`.

    Raises:
        UserError: no scorer is alive.
        typer.Exit: 1, a fan is not judged.
    """
    news: queue.Queue[Alarm] = queue.Queue()
    watcher = SiteWatcher(bus, config.site, roles_of(config), config.trays, has_scores=True, hear_alarm=news.put)
    wait_for_stages(bus, watcher, config, stop)
    watcher.ask_for_past_alarms()
    until_s = time.monotonic() + _SCORES_S
    while lacking := unjudged(watcher.model, watcher.states(process_list(config))):
        if time.monotonic() > until_s or stop.wait(_POLL_S):
            break
    for _ in range(news.qsize()):
        news.get()
    found = as_judged([each for each in watcher.current_alarms() if show_all or is_listed(each.newest)], lacking)
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
    return note_lines(
        replace(view.health, notes=tuple(note for note in view.health.notes if is_of_slow_change(note.text)))
        for view in watcher.stages()
        if view.alive
    )


def word(alarm: Alarm) -> str:
    """The transition, for machines."""
    return alarm.transition.name.lower()


def alarm_lines(current: CurrentAlarm, now: str = "") -> Text:
    """The alarm for people, in up to three lines: state, causes, message. now: what the fan does, if it is known."""
    alarm = current.newest
    by = f" by {current.acknowledged_by}" if current.acknowledged_by else ""
    words = [f"{word}{by}" if word == "acknowledged" else word for word in current.states()]
    words += [f"now {now}"] if now else []
    style = STYLES.get(alarm.severity, "bold red") if is_presented(alarm) else "dim"
    text = Text.assemble(
        (f"{alarm.header.tray} {alarm.label}  {alarm.severity.name:7}", style), f"  {', '.join(words)}"
    )
    if alarm.severity != Severity.NONE:
        lasted = duration_text(max(0, time.time_ns() - alarm.onset_t_ns) / NS_PER_S)
        text.append(f"  since {clock(alarm.onset_t_ns)} ({lasted})")
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
    return Text.assemble(
        f"{clock(alarm.t_ns)}  {alarm.header.tray} {alarm.label}  {alarm.severity.name:7}  ",
        (
            f"{alarm.transition.name.replace('_', ' ')}{by}",
            STYLES.get(alarm.severity, "bold red") if alarm.active else "",
        ),
        f"{why}  {alarm.about.removeprefix('refused: ')}",
    )


def probable(causes: Iterable[Diagnosis]) -> str:
    """The most probable cause, and the others that are probable enough to be listed."""
    return ", ".join(
        with_share(each) for number, each in enumerate(causes) if not number or each.probability >= MIN_PROBABILITY
    )


def show_history(recordings: Sequence[Path], config: Config | None, *, json_output: bool) -> None:
    """Print the alarms of recordings, or, without any, those that the gateway keeps on this host.

    Raises:
        UserError: a recording cannot be read, or there is no gateway's file.
    """
    notes: list[str] = []
    if recordings:
        with working(f"reading {', '.join(map(str, recordings))}"):
            alarms, by_tray = _recorded(recorded_files(recordings), notes)
    else:
        assert config is not None
        alarms, by_tray = _kept_by_gateway(config)
    rates = list(by_tray.values())
    found = {"alarms": [each.as_json() for each in alarms], "notes": notes}
    found |= {"rates": {tray: rate.as_json() for tray, rate in by_tray.items()}, "rate": together(rates).as_json()}
    named = list(by_tray.items()) + ([("together", together(rates))] if len(rates) > 1 else [])
    lines = [_line(each) for each in alarms] or [Text("no alarms", style="green")]
    lines += [Text(f"{name}: {_dated(rate)}") for name, rate in named]
    lines += [Text(note, style="yellow") for note in notes]
    show(found, *lines, json_output=json_output)


def _dated(rate: ObservedRate) -> str:
    since = f"since {format_local(rate.since_t_ns)}: " if rate.since_t_ns else ""
    return f"{since}{rate.text}"


def _line(alarm: Episode) -> Text:
    """One alarm, for people."""
    length_s = None if alarm.cleared_ns is None else (alarm.cleared_ns - alarm.onset_ns) / NS_PER_S
    lasted = "not over" if length_s is None else f"for {duration_text(length_s)}"
    causes = "".join(f"  {cause}" for cause in most_probable(alarm.causes))
    by = f" by {alarm.feedback_by}" if alarm.feedback_by else ""
    reason = f": {alarm.feedback_reason}" if alarm.feedback_reason else ""
    is_marked = alarm.feedback != Feedback.NONE
    return Text.assemble(
        f"{format_local(alarm.onset_ns)}  {alarm.tray} {alarm.label}  ",
        (f"{alarm.severity.upper():7}", STYLES[Severity[alarm.severity.upper()]]),
        f"  {lasted}{causes}  ",
        (f"{alarm.feedback.words}{by}{reason}" if is_marked else "not marked", "bold" if is_marked else ""),
    )


@dataclass
class _Tray:
    """What recordings say of a tray. judged_ns: summed over fans."""

    judged_ns: int = 0
    since_t_ns: int = 0
    declared_per_day: float | None = None


def _recorded(paths: Sequence[Path], notes: list[str]) -> tuple[list[Episode], dict[str, ObservedRate]]:
    """The alarms of recordings, and the rates by tray; what two recordings have counts once. notes: is given what is
    not known."""
    trays: defaultdict[str, _Tray] = defaultdict(_Tray)
    alarms: dict[tuple[str, str, int], Alarm] = {}
    newest: dict[tuple[str, str], int] = {}
    """by producer and tray, the sequence of the newest score"""
    for path in sorted(paths, key=_first_score_ns):
        require_no_clip(path, "and a rate from clips says nothing")
        for _, alarm in alarms_in(path):
            alarms[alarm.header.producer, alarm.header.tray, alarm.header.sequence] = alarm
        for envelope in rare_messages(path, "twin"):
            card = envelope.message
            if isinstance(card, ModelCard):
                trays[card.header.tray].declared_per_day = declared_per_day(card.card_json)
        if "score" in read_metadata(path).left_out:
            notes.append(f"{path}: the recorder has left out the scores, so how long fans were judged is not known")
        for envelope in read_recording(path, ("score",)).undecoded():
            with suppress(CodecError):
                _add_score(decode(Score, envelope.payload, ("valid",)), trays, newest)
    found = episodes(alarms.values())
    marks = Counter((each.tray, each.feedback) for each in found)
    return found, {
        name: ObservedRate(
            since_t_ns=trays[name].since_t_ns,
            fan_hours=trays[name].judged_ns / NS_PER_HOUR,
            false_alarms=marks[name, Feedback.FALSE_ALARM],
            true_alarms=marks[name, Feedback.TRUE_ALARM],
            unmarked=marks[name, Feedback.NONE],
            declared_per_day=trays[name].declared_per_day,
        )
        for name in sorted({*trays, *(each.tray for each in found)})
    }


def _first_score_ns(path: Path) -> int:
    return next((each.received_t_ns for each in read_recording(path, ("score",)).undecoded()), 0)


def _add_score(score: Score, trays: defaultdict[str, _Tray], newest: dict[tuple[str, str], int]) -> None:
    tray, stream = trays[score.header.tray], (score.header.producer, score.header.tray)
    if score.header.sequence > newest.get(stream, -1) and len(score.t_ns):
        newest[stream] = score.header.sequence
        first_t_ns = int(score.t_ns[0])
        tray.since_t_ns = min(tray.since_t_ns or first_t_ns, first_t_ns)
        tray.judged_ns += score.period_ns * int(np.count_nonzero(score.valid))


def _kept_by_gateway(config: Config) -> tuple[list[Episode], dict[str, ObservedRate]]:
    """From the files of the gateway's processes in the run folder.

    Raises:
        UserError: there is none, or one cannot be read.
    """
    files = [config.run_folder / own_file(shard.name, FILE) for shard in shards_of("gateway", config)]
    alarms: list[Alarm] = []
    rates: dict[str, ObservedRate] = {}
    for file in filter(Path.exists, files):
        alarms += [alarm for _, alarm in alarms_in(file)]
        with closing(AlarmHistory(file, read_only=True)) as kept:
            rates |= AlarmRates(kept).observed()
    if not any(map(Path.exists, files)):
        raise UserError(
            f"{files[0]}: no gateway has kept a history of alarms there; take it from recordings: "
            "fantwin alarms --history --recordings FILE..."
        )
    return episodes(alarms), rates
