"""The report on a run of the demo: the faults of the simulated tray against the recorded alarms."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.replay.offline.alarm_episodes import Episode, episodes
from fantwin.schemas.messages import Alarm, Raw, Score
from fantwin.schemas.units import NS_PER_S

SETTLING_NS = 5 * NS_PER_S  # an alarm is attributed to a fault until the fan has settled after its end


@dataclass(frozen=True)
class FaultSeen:
    """One fault and its alarm. Times are ns since the epoch; None where there was no alarm."""

    fan: int
    kind: str
    start_ns: int
    stop_ns: int
    alarm_ns: int | None
    cleared_ns: int | None
    cause: str = ""
    """most probable cause in the last diagnosis"""
    probability: float = 0.0

    @property
    def delay_s(self) -> float | None:
        """From the start of the fault to its alarm."""
        return None if self.alarm_ns is None else (self.alarm_ns - self.start_ns) / NS_PER_S


@dataclass(frozen=True)
class Summary:
    """The result of a run; `problems` is empty if the run met all expectations."""

    faults: list[FaultSeen]
    false_alarms: int
    samples_sent: int
    samples_recorded: int
    lost: int
    latency_ms: dict[str, float | None]
    lost_by_stage: dict[str, int]
    fans: int
    start_ns: int
    problems: list[str] = field(default_factory=list)

    def to_json(self) -> str:
        """The content of `summary.json`."""
        return json.dumps(asdict(self), indent=2, allow_nan=False)


def summarise(truth_path: Path, recordings: Iterable[Path], lost_by_stage: dict[str, int]) -> Summary:
    """Compare the recordings of one run with the simulated tray's own report.

    Raises:
        UserError: a file is missing or unreadable.
    """
    try:
        truth = json.loads(truth_path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(
            f"{truth_path}: no report of the simulated tray: {error}; did `fantwin simulate` run?"
        ) from error
    samples: set[tuple[str, int]] = set()
    """by tray and number, so that a repeated one hides no lost one"""
    latencies_ms: list[float] = []
    alarms: list[Alarm] = []
    for path in recordings:
        for entry in read_recording(path, topics=("raw", "score", "alarm")):
            message = entry.message
            if isinstance(message, Raw):
                samples |= {(message.header.tray, number) for number in message.device_sequence.tolist()}
            elif isinstance(message, Score):
                latencies_ms += ((entry.received_t_ns - message.t_ns) / 1e6).tolist()
            elif isinstance(message, Alarm):
                alarms.append(message)
    found = episodes(alarms)
    percentiles = np.percentile(latencies_ms, (50, 99)).tolist() if latencies_ms else (None, None)
    summary = Summary(
        faults=[_match(fault, found) for fault in truth["faults"]],
        false_alarms=sum(not any(_explains(fault, alarm) for fault in truth["faults"]) for alarm in found),
        samples_sent=truth["samples_sent"],
        samples_recorded=len(samples),
        lost=max(0, truth["samples_sent"] - len(samples)) + sum(lost_by_stage.values()),
        latency_ms={name: t_ms and round(t_ms, 3) for name, t_ms in zip(("p50", "p99"), percentiles, strict=True)},
        lost_by_stage=lost_by_stage,
        fans=truth["fans"],
        start_ns=truth["start_ns"],
    )
    return replace(summary, problems=list(_problems(summary)))


def _match(fault: dict[str, Any], alarms: list[Episode]) -> FaultSeen:
    seen = FaultSeen(fault["fan"], fault["kind"], fault["start_ns"], fault["stop_ns"], None, None)
    mine = (each for each in alarms if each.fan == seen.fan and seen.start_ns <= each.raised_ns <= seen.stop_ns)
    if (alarm := next(mine, None)) is None:
        return seen
    seen = replace(seen, alarm_ns=alarm.raised_ns, cleared_ns=alarm.cleared_ns)
    if not alarm.causes:
        return seen
    return replace(seen, cause=alarm.causes[0].cause, probability=round(alarm.causes[0].probability, 4))


def _explains(fault: dict[str, Any], alarm: Episode) -> bool:
    return fault["fan"] == alarm.fan and fault["start_ns"] <= alarm.raised_ns <= fault["stop_ns"] + SETTLING_NS


def _problems(summary: Summary) -> Iterable[str]:
    for fault in summary.faults:
        if fault.alarm_ns is None:
            yield f"the {fault.kind} fault of fan {fault.fan} was missed"
        elif fault.cleared_ns is None:
            yield f"the alarm of fan {fault.fan} was never cleared"
    if summary.false_alarms:
        yield f"{summary.false_alarms} alarms of healthy fans"
    if summary.lost:
        yield f"{summary.lost} samples or messages were lost"
    if not summary.samples_recorded:
        yield "nothing was recorded"
