"""Messages in words: short, plain, without markup, for a mail as for a phone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from urllib.parse import quote

from fantwin.pipeline.outputs.notify.deciding import Happened, Kind, ranges
from fantwin.schemas.enums import Severity
from fantwin.schemas.fan_names import MOST_LISTED
from fantwin.schemas.messages import Alarm, Diagnosis
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_text import deviation_in
from fantwin.scoring.alarms.current_alarms import CurrentAlarm
from fantwin.scoring.diagnosis.causes import (
    CANNOT_TELL,
    CAUSES,
    advice,
    less_likely,
    likely_causes,
    likely_evidence,
    likely_with_share,
)
from fantwin.scoring.diagnosis.ranked_causes import KNOWN_SOON

MOST_TRAYS, MOST_RANGE_CHARACTERS, MOST_NAMED_CAUSES = 20, 120, 4
"""of a message about many fans"""
_BEGINNING = {
    Kind.RAISED: "",
    Kind.WORSE: "Worse: ",
    Kind.CLEARED: "Cleared: ",
    Kind.AGAIN: "Still: ",
    Kind.ESCALATED: "Nobody has acknowledged: ",
    Kind.NOT_CONFIRMED: "Not confirmed by data: ",
}
_WHERE_IT_IS_KNOWN = "the page or `fantwin alarms` may show it by now"
_BY_IMPORTANCE = (Kind.ESCALATED, Kind.RAISED, Kind.WORSE, Kind.NOT_CONFIRMED, Kind.AGAIN, Kind.CLEARED)


class Level(StrEnum):
    """What a service may show by a colour."""

    INFO = "info"
    GOOD = "good"
    WARNING = "warning"
    ALARM = "alarm"


@dataclass(frozen=True)
class Text:
    """A message before it has a target."""

    title: str
    body: str
    level: Level


@dataclass(frozen=True)
class Place:
    """What all messages of a site say. page: address of the operators' page; may be empty."""

    site: str
    page: str = ""

    def clock(self, t_ns: int) -> str:
        """A date and a time of day in the time zone of the host."""
        try:
            at = datetime.fromtimestamp(t_ns / NS_PER_S).astimezone()
        except (ValueError, OverflowError, OSError):  # a device may send any time
            return "at an unknown time"
        return at.strftime("%Y-%m-%d %H:%M:%S %Z")

    def page_of(self, alarm: Alarm) -> str:
        """The address of a fan on the page; empty without a page."""
        return f"{self.page.rstrip('/')}/#/fan/{quote(alarm.header.tray, safe='')}/{alarm.fan}" if self.page else ""


def cause_line(causes: Sequence[Diagnosis]) -> str:
    """The likely causes with probability and evidence, and other ones that are probable."""
    if not causes:
        return "Cause: unknown"
    first = causes[0]
    if first.cause == CANNOT_TELL:
        # a message does not change: what is known later is elsewhere
        return f"Cause: {first.evidence or CAUSES[CANNOT_TELL]}".replace(KNOWN_SOON, _WHERE_IT_IS_KNOWN)
    others = [_with_probability(each) for each in less_likely(causes)]
    evidence = f" ({found})" if (found := likely_evidence(causes)) else ""
    return f"Cause: {likely_with_share(causes)}{evidence}{''.join(f', or {each}' for each in others)}"


def about_fan(place: Place, current: CurrentAlarm, happened: Happened, now_ns: int) -> Text:
    """A message about one fan."""
    kinds, alarm = happened.kinds, current.newest
    if alarm.active:
        beginning, word = _BEGINNING[min(kinds, key=_BY_IMPORTANCE.index)], alarm.severity.name
    else:
        is_new = bool({Kind.RAISED, Kind.ESCALATED} & set(kinds))
        beginning, word = "Raised and cleared: " if is_new else _BEGINNING[Kind.CLEARED], "alarm"
    lines = describe(place, current)
    if kinds[-1] == Kind.AGAIN and happened.number > 1:
        lines.append(f"This is reminder {happened.number}.")
    lines.append(f"As of {place.clock(now_ns)}")
    if address := place.page_of(alarm):
        lines.append(address)
    title = f"{beginning}{word}, {alarm.label} of {alarm.header.tray} ({place.site})"
    return Text(title, "\n".join(lines), _level([alarm]))


def describe(place: Place, current: CurrentAlarm) -> list[str]:
    """The alarm of a fan: since when, how far it is from its twin, the cause, what to do, and who knows."""
    alarm, deviation = current.newest, _deviation(place, current)
    fan = f"{alarm.label} of {alarm.header.tray} at {place.site}"
    if alarm.onset_t_ns == 0:
        return [f"{fan}: no alarm"]
    if not alarm.active:
        lines = [f"{fan}: back to normal; the alarm began {place.clock(alarm.onset_t_ns)}"]
        lines += [f"Deviation: {deviation}"] if deviation else []
    else:
        lines = [f"{fan}: {alarm.severity.name} since {place.clock(alarm.onset_t_ns)}"]
        lines += [deviation or "deviates from its twin", cause_line(current.causes)]
        if to_do := advice(current.causes):
            lines.append(f"What to do: {to_do}")
    if alarm.acknowledged:
        lines.append(f"Acknowledged{f' by {current.acknowledged_by}' if current.acknowledged_by else ''}.")
    else:
        lines.append("Not acknowledged.")
    if alarm.stale:
        lines.append("Not confirmed by data: there are no samples to judge.")
    return lines


def _deviation(place: Place, current: CurrentAlarm) -> str:
    """The deviation of the fan from its twin, by the last message that gives it, with its time; may be empty."""
    raised = current.raised
    deviation = deviation_in(raised.about) if raised else ""
    return f"{deviation} at {place.clock(raised.t_ns)}" if raised and deviation and raised.t_ns else deviation


def about_many(
    place: Place, fans: Sequence[tuple[CurrentAlarm, Happened]], now_ns: int, *, were_held: bool = False
) -> Text:
    """One message about many fans, or about those of quiet hours."""
    alarms = [each.newest for each, _ in fans]
    trays = {alarm.header.tray for alarm in alarms}
    active = [alarm for alarm in alarms if alarm.active]
    subject = f"{_count(len(fans), 'alarm')}{'' if active else ' cleared'} in {_count(len(trays), 'tray')}"
    counted = f": {', '.join(_how_many(fans))}" if active else ""
    lines = [f"{subject} at {place.site}{counted}"]
    if were_held:
        lines.insert(0, "Held during quiet hours:")
    lines += _of_each_tray(alarms)
    if active:
        causes = Counter(likely_causes(each.causes) or "unknown" for each, _ in fans if each.newest.active)
        named = [f"{words} {count}" for words, count in causes.most_common(MOST_NAMED_CAUSES)]
        lines.append(f"Most probable causes: {'; '.join(named)}")
        lines.append(f"The first alarm began {place.clock(min(each.onset_t_ns for each in active))}")
        if (stale := sum(each.stale for each in active)) > 0:
            lines.append(f"Not confirmed by data: {stale}")
    lines.append(f"As of {place.clock(now_ns)}")
    if place.page:
        lines.append(place.page)
    return Text(f"{subject} ({place.site}){counted}", "\n".join(lines), _level(alarms))


def test_text(place: Place, target: str, now_ns: int) -> Text:
    """A message that says that it is a test."""
    body = f"A test of target {target} of the notifier at {place.site}.\nAs of {place.clock(now_ns)}"
    return Text(f"Test ({place.site})", f"{body}\n{place.page}" if place.page else body, Level.INFO)


def _with_probability(cause: Diagnosis) -> str:
    return f"{CAUSES.get(cause.cause, cause.cause)}, {100 * cause.probability:.0f} %"


def _how_many(fans: Sequence[tuple[CurrentAlarm, Happened]]) -> list[str]:
    """How many are in alarm, warned of and cleared, and why they are in the message where that is not clear."""
    alarms = [each.newest for each, _ in fans]
    active: Mapping[str, int] = Counter(each.severity.name for each in alarms if each.active)
    parts = [f"{active[name]} {name}" for name in ("ALARM", "WARNING") if active.get(name)]
    if cleared := sum(not each.active for each in alarms):
        parts.append(f"{cleared} cleared")
    reasons = (
        (Kind.WORSE, "worse"),
        (Kind.AGAIN, "not acknowledged for a long time"),
        (Kind.ESCALATED, "acknowledged by nobody"),
        (Kind.NOT_CONFIRMED, "no longer confirmed by data"),
    )
    for kind, words in reasons:
        if count := sum(c.newest.active and kind in h.kinds and Kind.RAISED not in h.kinds for c, h in fans):
            parts.append(f"{count} {words}")
    return parts


def _of_each_tray(alarms: Sequence[Alarm]) -> list[str]:
    fans: dict[tuple[str, bool], dict[int, Alarm]] = {}
    for alarm in alarms:
        fans.setdefault((alarm.header.tray, not alarm.active), {})[alarm.fan] = alarm
    lines: list[str] = []
    for (tray, is_over), numbers in sorted(fans.items()):
        named = len(numbers) <= MOST_LISTED and any(alarm.fan_name for alarm in numbers.values())
        shown = ", ".join(numbers[fan].label for fan in sorted(numbers)) if named else ranges(numbers)
        if len(shown) > MOST_RANGE_CHARACTERS:
            shown = shown[:MOST_RANGE_CHARACTERS].rpartition(",")[0] + ", ..."
        lines.append(f"{tray}: {'cleared: ' if is_over else ''}{_count(len(numbers), 'fan')}: {shown}")
    more = len(lines) - MOST_TRAYS
    return lines[:MOST_TRAYS] + ([f"and {_count(more, 'more line')}"] if more > 0 else [])


def _count(number: int, word: str) -> str:
    return f"{number} {word}" if number == 1 else f"{number} {word}s"


def _level(alarms: Sequence[Alarm]) -> Level:
    highest = max((each.severity for each in alarms if each.active), default=0)
    if not highest:
        return Level.GOOD
    return Level.ALARM if highest >= Severity.ALARM else Level.WARNING
