"""Figures of detection: false alarms an hour, delays and misses of events, causes, and the volume under the surface.

An event is one fault of one fan. It is found if an alarm of that fan is raised between its start and its end; an alarm
that was already active does not count. An alarm raised neither in an event nor within `recovery_ns` after one is false.
There is no point adjustment: a detected sample does not count for the whole event around it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, chi2

THRESHOLDS = 250
NONE = "none reported"


@dataclass(frozen=True)
class Interval:
    """A figure and its confidence interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} .. {self.high:.3g})"


@dataclass(frozen=True)
class Event:
    """One fault of one fan, at times of its run. cause: the cause that an alarm should name."""

    run: str
    fan: int
    start_ns: int
    end_ns: int
    kind: str
    cause: str = ""


@dataclass(frozen=True)
class RaisedAlarm:
    """An alarm of a fan of a run. cleared_ns: None if still active. causes: the most probable first."""

    run: str
    fan: int
    raised_ns: int
    cleared_ns: int | None = None
    causes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """The outcome of an event. delay_s: NaN if it was missed. cause: the first one reported, empty without one."""

    event: Event
    delay_s: float
    cause: str = ""

    @property
    def is_found(self) -> bool:
        """Whether an alarm was raised in time."""
        return bool(np.isfinite(self.delay_s))


def rate(count: int, time: float, level: float = 0.95) -> Interval:
    """Events of a Poisson process a unit of time, with the exact interval of Garwood (Biometrika 28, 1936)."""
    tail = (1.0 - level) / 2.0
    low = chi2.ppf(tail, 2 * count) / 2.0 if count else 0.0
    high = chi2.ppf(1.0 - tail, 2 * (count + 1)) / 2.0
    return Interval(count / time, float(low) / time, float(high) / time)


def share(hits: int, of: int, level: float = 0.95) -> Interval:
    """A share, with the exact interval of Clopper and Pearson (Biometrika 26, 1934)."""
    found = binomtest(hits, of).proportion_ci(confidence_level=level, method="exact")
    return Interval(hits / of, float(found.low), float(found.high))


def outcomes(events: Iterable[Event], alarms: Iterable[RaisedAlarm]) -> list[Outcome]:
    """The outcome of each event, in the order of the events."""
    raised: dict[tuple[str, int], list[RaisedAlarm]] = {}
    for alarm in sorted(alarms, key=lambda one: one.raised_ns):
        raised.setdefault((alarm.run, alarm.fan), []).append(alarm)
    return [_outcome(event, raised.get((event.run, event.fan), ())) for event in events]


def _outcome(event: Event, alarms: Sequence[RaisedAlarm]) -> Outcome:
    for alarm in alarms:
        if event.start_ns <= alarm.raised_ns <= event.end_ns:
            return Outcome(event, (alarm.raised_ns - event.start_ns) / 1e9, alarm.causes[0] if alarm.causes else "")
    return Outcome(event, float("nan"))


def false_alarms(
    alarms: Iterable[RaisedAlarm], events: Iterable[Event], recovery_ns: int = 5_000_000_000
) -> list[RaisedAlarm]:
    """The alarms that no event explains."""
    spans: dict[tuple[str, int], list[tuple[int, int]]] = {}
    for event in events:
        spans.setdefault((event.run, event.fan), []).append((event.start_ns, event.end_ns + recovery_ns))
    return [
        alarm
        for alarm in alarms
        if not any(first <= alarm.raised_ns <= last for first, last in spans.get((alarm.run, alarm.fan), ()))
    ]


def confusion(found: Iterable[Outcome]) -> dict[str, Counter[str]]:
    """For the events that were found: true cause -> how often each cause was reported first."""
    table: dict[str, Counter[str]] = {}
    for one in found:
        if one.is_found:
            table.setdefault(one.event.cause, Counter())[one.cause or NONE] += 1
    return table


def vus_pr(anomalous: NDArray[np.bool_], score: NDArray[np.float64], buffers: Sequence[int]) -> float:
    """Volume under the precision-recall surface: the mean of the range-based areas over lengths of the buffer.

    Around each event lie buffers of half a length on either side, where a prediction counts sqrt(1 - distance /
    length); recall is multiplied by the share of events that were seen at all. Paparrizos et al., PVLDB 15 (2022) 2774,
    as the authors' package computes it (`RangeAUC_volume_opt`).

    anomalous, score: (n,); a score of NaN is the lowest of all. buffers: lengths in samples, usually 0 to the longest.

    Raises:
        ValueError: nothing is anomalous.
    """
    if not anomalous.any():
        raise ValueError("no sample is anomalous: there is no recall")
    score = np.where(
        np.isnan(score), np.nanmin(score, initial=np.inf) - 1.0 if np.isfinite(score).any() else 0.0, score
    )
    order = np.argsort(-score, kind="stable")
    falling = score[order]
    limits = falling[np.linspace(0, len(score) - 1, THRESHOLDS).astype(int)]
    predicted = np.searchsorted(-falling, -limits, side="right")
    spans = _spans(anomalous)
    return float(np.mean([_range_pr(anomalous, score, order, limits, predicted, spans, one) for one in buffers]))


def _range_pr(
    anomalous: NDArray[np.bool_],
    score: NDArray[np.float64],
    order: NDArray[np.int64],
    limits: NDArray[np.float64],
    predicted: NDArray[np.int64],
    spans: Sequence[tuple[int, int]],
    buffer: int,
) -> float:
    weight = _with_buffers(anomalous, spans, buffer)
    true_positive = np.cumsum(weight[order])[predicted - 1]
    in_buffers = true_positive - np.cumsum(anomalous[order])[predicted - 1]
    positive = np.sum(anomalous) + in_buffers / 2.0
    wide = _widened(spans, buffer // 2, len(anomalous))
    best = np.array([score[first : last + 1].max() for first, last in wide])
    seen = np.mean(best[:, np.newaxis] >= limits, axis=0)
    recall = np.minimum(true_positive / positive, 1.0) * seen
    return float(np.sum(np.diff(recall, prepend=0.0) * true_positive / predicted))


def _spans(anomalous: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last sample of each stretch."""
    edges = np.diff(np.concatenate(([False], anomalous, [False])).astype(np.int8))
    return list(zip(np.flatnonzero(edges == 1).tolist(), (np.flatnonzero(edges == -1) - 1).tolist(), strict=True))


def _with_buffers(anomalous: NDArray[np.bool_], spans: Sequence[tuple[int, int]], buffer: int) -> NDArray[np.float64]:
    weight = anomalous.astype(np.float64)
    for first, last in spans:
        after = np.arange(last + 1, min(last + buffer // 2 + 1, len(weight)))
        weight[after] += np.sqrt(1.0 - (after - last) / max(buffer, 1))
        before = np.arange(max(first - buffer // 2, 0), first)
        weight[before] += np.sqrt(1.0 - (first - before) / max(buffer, 1))
    return np.minimum(weight, 1.0)


def _widened(spans: Sequence[tuple[int, int]], by: int, length: int) -> list[tuple[int, int]]:
    """The stretches with their buffers; those that touch are one."""
    wide: list[tuple[int, int]] = []
    for first, last in spans:
        start, end = max(first - by, 0), min(last + by, length - 1)
        if wide and start <= wide[-1][1]:
            start = wide.pop()[0]
        wide.append((start, end))
    return wide
