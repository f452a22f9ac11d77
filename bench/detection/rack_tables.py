"""The tables of the racks: false alarms, faults by kind beside what their tachos can show, and the other methods."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.detection.metrics import Event, Interval, RaisedAlarm, outcomes, rate
from bench.detection.ours import NAME
from bench.detection.rack_campaign import RackResult, campaign
from bench.detection.rack_limits import Facts, facts_of_rack
from bench.detection.rack_recordings import FAULTY, HEALTHY, RackData
from bench.detection.rack_scoring import DECLARED_PER_DAY, Episode, Judged
from bench.detection.racks import FAULT_KINDS, events, run_of
from schemas.units import NS_PER_S

AFTER_S = 1800.0
"""an alarm of a fan within this time after its fault is one of the fault's end, and not false"""
Rows = list[dict[str, Any]]
Progress = Callable[[str], None]
RACK_NOTES = (
    f"declared: {DECLARED_PER_DAY:g} false alarm of a fan a day; extrapolated from 15 minutes",
    "outside of faults: alarms of fans without a fault, or more than 30 min after the end of theirs",
    "the tacho's limit: when somebody who knows the fan perfectly could tell (bench/detection/rack_limits.py)",
    "right cause: the cause that the alarm named first, and the one on top when it was last diagnosed",
    "all other limits: as many excursions as declared on the recordings that the twin is calibrated on",
)


@dataclass(frozen=True)
class Found:
    """What became of one fault."""

    event: Event
    facts: Facts
    delay_s: float
    """NaN if no alarm was raised while it lasted"""
    alarms: int
    first_cause: str
    last_cause: str
    is_moved: bool
    """the command moved between the beginning of the fault and the end of its first alarm"""


@dataclass(frozen=True)
class Campaign:
    """The results of one rate. events, facts: by rack. test_s: length of the test."""

    rate_hz: float
    test_s: float
    results: Sequence[RackResult]
    events: dict[int, list[Event]]
    facts: dict[int, list[Facts]]

    @property
    def learning(self) -> list[str]:
        """The amounts of learning."""
        return list(dict.fromkeys(one.learning for one in self.results))

    def of(self, learning: str) -> list[RackResult]:
        """The results with an amount of learning."""
        return [one for one in self.results if one.learning == learning]


def rack_tables(
    data: RackData, learning: Sequence[str], racks: int, healthy_racks: int, workers: int, progress: Progress
) -> dict[str, Rows]:
    """All tables of one rate. racks: so many of the data's are judged; healthy_racks: of these without faults, too."""
    results = campaign(data, learning, racks, racks if healthy_racks < 0 else healthy_racks, workers, progress)
    truth = events(data.faults())
    of_rack = {rack: [one for one in truth if one.run == run_of(rack)] for rack in range(racks)}
    facts = {
        rack: facts_of_rack(data.test(HEALTHY, rack), data.test(FAULTY, rack), of_rack[rack]) for rack in range(racks)
    }
    shown = Campaign(data.rate_hz, data.test_s, results, of_rack, facts)
    at = f"racks at {data.rate_hz:g} Hz"
    return {
        f"{at}: false alarms": false_alarm_rows(shown),
        f"{at}: faults, fantwin": kind_rows(shown),
        f"{at}: causes reported last by fantwin": confusion_rows(shown),
        f"{at}: faults found and median delay, by method": method_rows(shown),
    }


def as_raised(judged: Judged, run: str, method: str) -> list[RaisedAlarm]:
    """The alarms of a method in a run."""
    if method == NAME:
        return [RaisedAlarm(run, one.fan, one.raised_ns, one.cleared_ns) for one in judged.ours]
    return [RaisedAlarm(run, one.fan, one.raised_ns, one.cleared_ns) for one in judged.others[method]]


def found_faults(result: RackResult, events: Sequence[Event], facts: Sequence[Facts]) -> list[Found]:
    """What the scorer made of each fault of a rack."""
    made = []
    for event, fact in zip(events, facts, strict=True):
        alarms = [
            one
            for one in result.faulty.ours
            if one.fan == event.fan and event.start_ns <= one.raised_ns <= event.end_ns
        ]
        first = alarms[0] if alarms else None
        delay_s = (first.raised_ns - event.start_ns) / NS_PER_S if first else float("nan")
        over_ns = min(first.cleared_ns or event.end_ns, event.end_ns) if first else event.end_ns
        is_moved = fact.moved_after_s <= (over_ns - event.start_ns) / NS_PER_S
        made.append(Found(event, fact, delay_s, len(alarms), _cause(first, 0), _cause(first, 1), bool(is_moved)))
    return made


def _cause(alarm: Episode | None, at: int) -> str:
    return (alarm.first_cause, alarm.last_cause)[at] if alarm else ""


def beside(judged: Judged, run: str, method: str, events: Sequence[Event]) -> tuple[int, int]:
    """False alarms of a method in a run, and those that follow the end of a fault."""
    false = after = 0
    for alarm in as_raised(judged, run, method):
        own = [one for one in events if one.fan == alarm.fan and one.start_ns <= alarm.raised_ns]
        newest = max(own, key=lambda one: one.start_ns, default=None)
        if newest is None or alarm.raised_ns > newest.end_ns + AFTER_S * NS_PER_S:
            false += 1
        elif alarm.raised_ns > newest.end_ns:
            after += 1
    return false, after


def false_alarm_rows(shown: Campaign) -> Rows:
    """False alarms in the healthy test, and in that with faults outside of them."""
    rows: Rows = []
    for learning in shown.learning:
        results = shown.of(learning)
        healthy = [one.healthy for one in results if one.healthy]
        for method in (NAME, *results[0].faulty.others):
            row = {**_where(shown, learning, len(results)), "method": method}
            raised = sum(len(as_raised(one, "", method)) for one in healthy)
            hours = sum(one.fan_hours for one in healthy)
            row |= _rate("healthy test", raised, hours)
            counts = [beside(one.faulty, "", method, shown.events[one.rack]) for one in results]
            hours = sum(one.faulty.fan_hours - _in_faults_h(shown.events[one.rack]) for one in results)
            row |= _rate("outside of faults", sum(false for false, _ in counts), hours)
            row["within 30 min after one"] = sum(after for _, after in counts)
            rows.append(row)
    return rows


def _rate(where: str, raised: int, hours: float) -> dict[str, Any]:
    if hours <= 0.0:
        return {f"{where}: alarms": "-", "fan-h": "-", f"{where}, a fan and day (95 %)": "-"}
    interval: Interval = rate(raised, hours / 24.0)
    return {
        f"{where}: alarms in fan-h": f"{raised} in {hours:.0f}",
        f"{where}: a fan and day (95 %); declared {DECLARED_PER_DAY:g}": str(interval),
    }


def _in_faults_h(events: Iterable[Event]) -> float:
    return sum((one.end_ns - one.start_ns) / NS_PER_S + AFTER_S for one in events) / 3600.0


def kind_rows(shown: Campaign) -> Rows:
    """The results of fantwin for each kind of fault, beside what the tachos can show."""
    rows: Rows = []
    for learning in shown.learning:
        results = shown.of(learning)
        found = [
            one
            for result in results
            for one in found_faults(result, shown.events[result.rack], shown.facts[result.rack])
        ]
        for kind in FAULT_KINDS:
            of = [one for one in found if one.event.kind == kind]
            hits = [one for one in of if np.isfinite(one.delay_s)]
            moved = [one for one in hits if one.is_moved]
            rows.append(
                {
                    **_where(shown, learning, len(results)),
                    "fault": kind,
                    "found": f"{len(hits)} of {len(of)}",
                    "delay s: median, 90 %": _quantiles([one.delay_s for one in hits]),
                    "tacho's limit s: median, 90 %": _quantiles([one.facts.limit_s for one in of]),
                    "beyond it: median, 90 %": _quantiles([one.delay_s - one.facts.limit_s for one in hits]),
                    "alarms a fault found": f"{np.mean([one.alarms for one in hits]):.1f}" if hits else "-",
                    "right cause, command moved: first, last": _right(moved),
                    "command held": _right([one for one in hits if not one.is_moved]),
                }
            )
    return rows


def method_rows(shown: Campaign) -> Rows:
    """What each method finds of each kind, and the median delay."""
    rows: Rows = []
    for learning in shown.learning:
        results = shown.of(learning)
        for method in (NAME, *results[0].faulty.others):
            row = {**_where(shown, learning, len(results)), "method": method}
            found = [
                one
                for result in results
                for one in outcomes(shown.events[result.rack], as_raised(result.faulty, run_of(result.rack), method))
            ]
            for kind in FAULT_KINDS:
                of = [one for one in found if one.event.kind == kind]
                hits = [one.delay_s for one in of if one.is_found]
                delay = f", {np.median(hits):.3g} s" if hits else ""
                row[kind] = f"{len(hits)} of {len(of)}{delay}"
            rows.append(row)
    return rows


def _where(shown: Campaign, learning: str, racks: int) -> dict[str, Any]:
    return {"Hz": f"{shown.rate_hz:g}", "learned": learning, "racks x h": f"{racks} x {shown.test_s / 3600:g}"}


def _quantiles(values: Sequence[float]) -> str:
    known = [value for value in values if np.isfinite(value)]
    if not known:
        return "-"
    beyond = f" ({len(values) - len(known)} never)" if len(known) < len(values) else ""
    return f"{np.median(known):.3g}, {np.quantile(known, 0.9):.3g}{beyond}"


def _right(found: Sequence[Found]) -> str:
    if not found:
        return "-"
    first, last = (
        sum(cause == one.event.cause for one, cause in zip(found, causes, strict=True))
        for causes in ([one.first_cause for one in found], [one.last_cause for one in found])
    )
    return f"{first}, {last} of {len(found)}"


def confusion_rows(shown: Campaign) -> Rows:
    """The causes that were reported last, by kind of fault."""
    rows: Rows = []
    for learning in shown.learning:
        found = [
            one
            for result in shown.of(learning)
            for one in found_faults(result, shown.events[result.rack], shown.facts[result.rack])
            if one.alarms
        ]
        for kind in FAULT_KINDS:
            causes = [one.last_cause or "none" for one in found if one.event.kind == kind]
            counted = sorted(set(causes), key=lambda cause: -causes.count(cause))
            reported = ", ".join(f"{cause} {causes.count(cause)}" for cause in counted)
            rows.append(
                {
                    **_where(shown, learning, len(shown.of(learning))),
                    "fault": kind,
                    "should be": FAULT_KINDS[kind],
                    "reported last": reported or "-",
                }
            )
    return rows
