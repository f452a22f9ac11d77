"""The tables of the racks: false alarms, faults by kind beside what their tachos can show, and the other methods."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.detection.metrics import Event, RaisedAlarm, outcomes, rate
from bench.detection.ours import NAME
from bench.detection.rack_campaign import RackResult, campaign
from bench.detection.rack_limits import Facts, facts_of_rack
from bench.detection.rack_recordings import FAULTY, HEALTHY, RackData
from bench.detection.rack_scoring import DECLARED_PER_DAY, Episode, Judged
from bench.detection.racks import FAULT_KINDS, events, run_of
from fantwin.schemas.units import NS_PER_S
from fantwin.simulation.faults import CLOG_S

AFTER_S = 1800.0
"""an alarm of a fan within this time after its fault is one of the fault's end, and not false"""
ASKED_S = {"blocked": 2.0, "no-power": 2.0, "blade": 5.0, "clog": CLOG_S, "bearing": 3600.0}
ASKED_BEYOND_LIMIT = ("blocked", "no-power")
"""asked is a time after the tacho can show them, of the others one after they begin"""
SHOWN = "the tacho shows it after"
Rows = list[dict[str, Any]]
Progress = Callable[[str], None]
RACK_NOTES = (
    f"declared: {DECLARED_PER_DAY:g} false alarm of a fan a day; with 15 minutes of learning a target",
    "beside faults: alarms of fans without a fault, or over 30 min after the end of theirs; after: those before that",
    "a method that raises alarms all the time finds faults by chance: compare those with the same false alarms",
    f"{SHOWN}: when somebody who knows the fan perfectly could tell (bench/detection/rack_limits.py)",
    "in time: blocked and no power within 2 s after that, blade 5 s, clog 180 s, bearing an hour",
    "cause, command moved or held: how often right, the one named first and the one on top at the last diagnosis",
    "limits of the other methods: as many excursions as declared on the recordings that the twin is calibrated on",
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
    """The results of one rate. events, facts: by rack."""

    results: Sequence[RackResult]
    events: dict[int, list[Event]]
    facts: dict[int, list[Facts]]

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
    shown = Campaign(results, of_rack, facts)
    tables: dict[str, Rows] = {}
    for name in learning:
        of = shown.of(name)
        at = f"{data.rate_hz:g} Hz, learned from {name}, {len(of)} racks for {data.test_s / 3600:g} h"
        tables |= {
            f"{at}: false alarms": false_alarm_rows(shown, of),
            f"{at}: faults, fantwin": kind_rows(shown, of),
            f"{at}: causes on top when last diagnosed, fantwin": cause_rows(shown, of),
            f"{at}: found and median delay, by method": method_rows(shown, of),
        }
    return tables


def as_raised(judged: Judged, run: str, method: str) -> list[RaisedAlarm]:
    """The alarms of a method in a run."""
    if method == NAME:
        return [RaisedAlarm(run, one.fan, one.raised_ns, one.cleared_ns, (one.last_cause,)) for one in judged.ours]
    return [replace(one, run=run) for one in judged.others[method]]


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


def false_alarm_rows(shown: Campaign, results: Sequence[RackResult]) -> Rows:
    """False alarms in the healthy test, and in that with faults beside them."""
    rows: Rows = []
    healthy = [one.healthy for one in results if one.healthy]
    healthy_h = sum(one.fan_hours for one in healthy)
    beside_h = sum(one.faulty.fan_hours - hours_in_faults(shown.events[one.rack]) for one in results)
    for method in _methods(results):
        raised = sum(len(as_raised(one, "", method)) for one in healthy)
        counts = [beside(one.faulty, "", method, shown.events[one.rack]) for one in results]
        false = sum(count for count, _ in counts)
        rows.append(
            {
                "method": method,
                "healthy": f"{raised} in {healthy_h:.0f} h",
                "a fan and day (95 %)": _rate(raised, healthy_h),
                "beside faults": f"{false} in {beside_h:.0f} h",
                "a fan, day (95 %)": _rate(false, beside_h),
                "after": str(sum(after for _, after in counts)),
            }
        )
    return rows


def _rate(raised: int, hours: float) -> str:
    return str(rate(raised, hours / 24.0)) if hours > 0.0 else "-"


def hours_in_faults(events: Iterable[Event]) -> float:
    """Fan-hours in which alarms of these fans are not false."""
    return sum((one.end_ns - one.start_ns) / NS_PER_S + AFTER_S for one in events) / 3600.0


def _methods(results: Sequence[RackResult]) -> tuple[str, ...]:
    return (NAME, *results[0].faulty.others)


def _all_found(shown: Campaign, results: Sequence[RackResult]) -> list[Found]:
    return [
        one for result in results for one in found_faults(result, shown.events[result.rack], shown.facts[result.rack])
    ]


def kind_rows(shown: Campaign, results: Sequence[RackResult]) -> Rows:
    """The results of fantwin for each kind of fault, beside what the tachos can show."""
    rows: Rows = []
    found = _all_found(shown, results)
    for kind in FAULT_KINDS:
        of = [one for one in found if one.event.kind == kind]
        hits = [one for one in of if np.isfinite(one.delay_s)]
        rows.append(
            {
                "fault": kind,
                "found": f"{len(hits)} of {len(of)}",
                "in time": _in_time(kind, hits, len(of)),
                "delay s (90 %)": _quantiles([one.delay_s for one in hits]),
                SHOWN: _quantiles([one.facts.limit_s for one in of]),
                "beyond it": _quantiles([one.delay_s - one.facts.limit_s for one in hits]),
                "alarms": f"{np.mean([one.alarms for one in hits]):.1f}" if hits else "-",
                "cause: moved": _right([one for one in hits if one.is_moved]),
                "held": _right([one for one in hits if not one.is_moved]),
            }
        )
    return rows


def _in_time(kind: str, hits: Sequence[Found], of: int) -> str:
    if kind not in ASKED_S:
        return "-"
    of_limit = kind in ASKED_BEYOND_LIMIT
    delays_s = [one.delay_s - (one.facts.limit_s if of_limit else 0.0) for one in hits]
    return f"{sum(delay_s <= ASKED_S[kind] for delay_s in delays_s)} of {of}"


def method_rows(shown: Campaign, results: Sequence[RackResult]) -> Rows:
    """How many faults of each kind each method finds, and the median delay in s; first when the tacho shows them."""
    limits_s: dict[str, list[float]] = {kind: [] for kind in FAULT_KINDS}
    for result in results:
        for event, fact in zip(shown.events[result.rack], shown.facts[result.rack], strict=True):
            limits_s[event.kind].append(fact.limit_s)
    rows: Rows = [{"method": SHOWN, **{kind: _shown(limits_s[kind]) for kind in FAULT_KINDS}, "last cause right": "-"}]
    for method in _methods(results):
        row: dict[str, Any] = {"method": method}
        found = [
            one
            for result in results
            for one in outcomes(shown.events[result.rack], as_raised(result.faulty, run_of(result.rack), method))
        ]
        for kind in FAULT_KINDS:
            of = [one for one in found if one.event.kind == kind]
            hits = [one.delay_s for one in of if one.is_found]
            row[kind] = f"{len(hits)}/{len(of)}" + (f" {np.median(hits):.2g}" if hits else "")
        named = [one for one in found if one.cause]
        row["last cause right"] = f"{sum(one.cause == one.event.cause for one in named)}/{len(found)}" if named else "-"
        rows.append(row)
    return rows


def _quantiles(values: Sequence[float]) -> str:
    known = [value for value in values if np.isfinite(value)]
    if not known:
        return "-"
    beyond = f", {len(values) - len(known)} never" if len(known) < len(values) else ""
    return f"{np.median(known):.3g} ({np.quantile(known, 0.9):.3g}){beyond}"


def _shown(limits_s: Sequence[float]) -> str:
    known = [limit_s for limit_s in limits_s if np.isfinite(limit_s)]
    return f"{len(known)}/{len(limits_s)}" + (f" {np.median(known):.2g}" if known else "")


def _right(found: Sequence[Found]) -> str:
    first, last = (
        sum(cause == one.event.cause for one, cause in zip(found, causes, strict=True))
        for causes in ([one.first_cause for one in found], [one.last_cause for one in found])
    )
    return f"{first}, {last} of {len(found)}" if found else "-"


def cause_rows(shown: Campaign, results: Sequence[RackResult]) -> Rows:
    """The causes on top when the first alarm of each fault was last diagnosed."""
    rows: Rows = []
    found = [one for one in _all_found(shown, results) if one.alarms]
    for kind in FAULT_KINDS:
        causes = Counter(one.last_cause or "none" for one in found if one.event.kind == kind)
        reported = ", ".join(f"{cause} {count}" for cause, count in causes.most_common())
        rows.append({"fault": kind, "should be": FAULT_KINDS[kind], "reported": reported or "-"})
    return rows
