"""`fantwin alarms --history`: the alarms that were, what operators said of them, and the rate of false alarms."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.text import Text

from fantwin.pipeline.cli.printing import duration_text, show
from fantwin.pipeline.cli.progress import working
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import own_file, shards_of
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.clips.clip import require_no_clip
from fantwin.pipeline.recordings.dates import format_local
from fantwin.pipeline.recordings.rare_messages import rare_messages
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.recordings.run_recordings import recorded_files
from fantwin.pipeline.replay.offline.alarm_episodes import Episode, episodes
from fantwin.pipeline.replay.offline.marked_alarms import alarms_in
from fantwin.pipeline.site.alarm_history import FILE, AlarmHistory
from fantwin.pipeline.site.alarm_rates import AlarmRates
from fantwin.schemas.codec import CodecError, decode
from fantwin.schemas.enums import Feedback
from fantwin.schemas.messages import Alarm, ModelCard, Score
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.calibration.observed_rate import ObservedRate, declared_per_day, together
from fantwin.scoring.diagnosis.causes import with_share

NS_PER_HOUR = 3600 * NS_PER_S
_STYLES = {"warning": "yellow", "alarm": "bold red"}


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
        (f"{alarm.severity.upper():7}", _STYLES.get(alarm.severity, "")),
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
