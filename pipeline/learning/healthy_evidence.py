"""What healthy recordings say for and against a calibration: alarms that operators marked, fans that were probably not
healthy, and whether a declared rate of false alarms is kept.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.prediction.tray_twin import TrayTwin, load_tray_twin
from fantwin.pipeline.recordings.checksum import sha256_of
from fantwin.pipeline.recordings.clips.clip import require_no_clip
from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.replay.offline.alarm_episodes import (
    LeftOut,
    MarkedAlarm,
    alarms_in,
    concerning,
    episodes,
    marked_alarms,
)
from fantwin.pipeline.replay.offline.calibration_of_twin import CalibratedTwin, calibration_in, number_text
from fantwin.pipeline.replay.offline.healthy_runs import DecidedRun, HealthyPart, LearnedRun, MapRecordings
from fantwin.pipeline.replay.offline.rescoring import rescore
from fantwin.schemas.enums import Feedback
from fantwin.schemas.messages import Alarm
from fantwin.schemas.twin_card import DataCard, TwinCard
from fantwin.scoring.calibration.calibration import Calibration, daily_interval, expected_alarms, is_exceeded
from fantwin.scoring.model.population import Priors


@dataclass(frozen=True)
class MarkedRunning:
    """The alarms that concern some recordings."""

    alarms: tuple[MarkedAlarm, ...]

    @property
    def left_out(self) -> tuple[LeftOut, ...]:
        """Times of fans that are not learned from."""
        return tuple(span for each in self.alarms if (span := each.left_out) is not None)

    @property
    def lines(self) -> list[str]:
        """One for each alarm that is marked, and one for all others."""
        lines = [each.line for each in self.alarms if each.line]
        unmarked = sum(each.alarm.feedback == Feedback.NONE for each in self.alarms)
        if unmarked:
            are = "alarm in the recordings is" if unmarked == 1 else "alarms in the recordings are"
            lines.append(f"{unmarked} {are} not marked as true or false: used as healthy running")
        return lines

    def as_json(self) -> list[dict[str, Any]]:
        """Fields for --json."""
        return [each.as_json() for each in self.alarms]


def marked_running(
    recordings: Sequence[Path], feedback: Sequence[Path], tray: str | None, each: MapRecordings
) -> MarkedRunning:
    """What operators said of the alarms in recordings. feedback: other files in which they said it. tray: the only one
    that is used. each: does the work on each recording.

    Raises:
        UserError: one cannot be read, or a recording is the clip of an alarm.
    """
    found = [*each(_of_recording, recordings, "looking for alarms in recordings"), *map(_named, feedback)]
    alarms = [marked for marked in marked_alarms(found) if tray in (None, marked.alarm.tray)]
    if feedback:
        spans = [(contents.first_ns or 0, contents.last_ns or 0) for contents in map(contents_of, recordings)]
        alarms = [marked for marked in alarms if marked.first_file in recordings or _is_within(marked, spans)]
    return MarkedRunning(tuple(alarms))


def _of_recording(path: Path) -> tuple[Path, list[tuple[str, Alarm]]]:
    require_no_clip(path, "and no picture of healthy running")
    return _named(path)


def _named(path: Path) -> tuple[Path, list[tuple[str, Alarm]]]:
    return path, alarms_in(path)


def _is_within(marked: MarkedAlarm, spans: Sequence[tuple[int, int]]) -> bool:
    alarm = marked.alarm
    return any(
        alarm.onset_ns <= last_ns and (alarm.cleared_ns is None or alarm.cleared_ns >= first_ns)
        for first_ns, last_ns in spans
    )


LEAST_FANS = 4
"""fans, counted over all runs: with fewer the median says little"""
OUTLIER_RATIO = 5.0
"""times the median: one healthy fan in a thousand differs from its twin by so much more than the others"""
SO_LEAVE_IT_OUT = "if something was wrong there, calibrate without this recording"


def outlier_warnings(found: CalibratedTwin) -> list[str]:
    """A line for the fan whose mean speed differs most, and one for the fan with most alarms, where that is much."""
    warnings = [_of_mean(found.learned)]
    if found.calibration.limit_factor > 1.0 or found.calibration.is_exceeded:
        warnings.append(_of_alarms(found.by_theory))
    return [warning for warning in warnings if warning]


def training_warnings(card: TwinCard, calibration: Calibration) -> list[str]:
    """A line where a calibration used running that the twin was trained on."""
    used = [
        DataCard(
            data["name"], data["sha256"], 0, 0, data.get("from_s"), math.nextafter(data.get("to_s", math.inf), 0.0)
        )
        for data in calibration.data
    ]
    names = [each.name for each in used if any(map(each.overlaps, card.training.data))]
    if not names:
        return []
    return [
        f"{', '.join(names)}: the twin was trained on it, so its errors are too small there, and alarms may come more "
        "often than declared: calibrate on other healthy recordings"
    ]


def _of_mean(runs: Sequence[LearnedRun]) -> str:
    shares = [
        (abs(float(share)), float(share), run, fan)
        for run in runs
        for fan, share in enumerate(run.sums.mean_share)
        if math.isfinite(share)
    ]
    if len(shares) < LEAST_FANS:
        return ""
    median = float(np.median([size for size, *_ in shares]))
    size, share, run, fan = max(shares, key=lambda each: each[0])
    if size <= max(OUTLIER_RATIO * median, Priors().twin_share):
        return ""
    than = "faster" if share > 0.0 else "slower"
    return (
        f"{run.tray.path}: {run.tray.tray} {run.tray.names.label(fan)} is {100 * size:.2g} % {than} than its twin on "
        f"average, the median of all fans is {100 * median:.2g} %: {SO_LEAVE_IT_OUT}"
    )


def _of_alarms(runs: Sequence[DecidedRun]) -> str:
    alarms = [(count, run, fan) for run in runs for fan, count in enumerate(run.alarms)]
    total = sum(count for count, *_ in alarms)
    most, run, fan = max(alarms, key=lambda each: each[0])
    if 2 * most <= total or len(alarms) == 1:
        return ""
    return (
        f"{run.tray.path}: {run.tray.tray} {run.tray.names.label(fan)} has {most} of the {total} alarms that the limit "
        f"by theory raises: {SO_LEAVE_IT_OUT}"
    )


NS_PER_HOUR = 3.6e12


@dataclass(frozen=True)
class Check:
    """The number of alarms in a number of fan-hours, and the declared rate per fan and day."""

    alarms: int
    fan_hours: float
    declared_per_day: float

    @property
    def expected(self) -> float:
        """Number of alarms by the declared rate."""
        return expected_alarms(self.fan_hours, self.declared_per_day)

    @property
    def interval_95(self) -> tuple[float, float]:
        """95 % confidence interval of the rate per fan and day."""
        return daily_interval(self.alarms, self.fan_hours)

    @property
    def is_broken(self) -> bool:
        """Whether there were more alarms than chance explains: the whole interval is above the declared rate."""
        return is_exceeded(self.alarms, self.fan_hours, self.declared_per_day)

    @property
    def text(self) -> str:
        """The result in one line."""
        low, high = self.interval_95
        found = (
            f"{self.alarms} alarm{'s' * (self.alarms != 1)} in {self.fan_hours:.3g} fan-hours: "
            f"{number_text(self.alarms / self.fan_hours * 24)} per fan and day "
            f"(95 %: {number_text(low)} to {number_text(high)}); "
            f"declared {self.declared_per_day:g}"
        )
        if self.is_broken:
            return f"{found}: not kept"
        if self.expected < 1.0:
            return f"{found}: kept, as far as so few data can show ({self.expected:.2g} alarms were expected)"
        return f"{found}: kept"

    def as_json(self) -> dict[str, Any]:
        """The same for --json."""
        return {
            "alarms": self.alarms,
            "fan_hours": self.fan_hours,
            "declared_per_day": self.declared_per_day,
            "interval_95": self.interval_95,
            "expected": self.expected,
            "kept": not self.is_broken,
        }


def check_declared_rate(
    twin: Path,
    recordings: Sequence[Path],
    overrides: Sequence[str],
    each: MapRecordings,
    tray: str | None = None,
    left_out: Sequence[LeftOut] = (),
) -> Check:
    """Count alarms on other healthy recordings, processed as by `fantwin replay --offline`.

    tray: the only one that is used; without it all are. left_out: times of fans in which an alarm is no false one.

    Raises:
        UserError: the twin is not calibrated, or was made from one of the recordings; a recording cannot be used, or
            none of its samples could be scored.
    """
    loaded = load_tray_twin(twin)
    calibration = calibration_in(twin, loaded)
    if calibration is None:
        raise UserError(f"{twin}: its alarms were never calibrated: give healthy recordings and --false-alarms-per-day")
    made_from = _made_from(twin, loaded, calibration)
    list(each(partial(_refuse_its_own, made_from=made_from), recordings, "looking for its own recordings"))
    count = partial(_count_alarms, twin=twin, overrides=tuple(overrides), tray=tray, left_out=tuple(left_out))
    counts = list(each(count, recordings, "scoring other healthy recordings"))
    return Check(
        sum(alarms for alarms, _ in counts), sum(hours for _, hours in counts), calibration.false_alarms_per_day
    )


def _count_alarms(
    path: Path, twin: Path, overrides: tuple[str, ...], tray: str | None, left_out: tuple[LeftOut, ...]
) -> tuple[int, float]:
    """Alarms of one recording, and the fan-hours that could be scored."""
    alarms, fan_hours = 0, 0.0
    with HealthyPart(twin, overrides, tray=tray).opened(path) as replay_input:
        for each, rescored in zip(replay_input.trays, rescore(replay_input, None, False), strict=True):
            if rescored.problem:
                raise UserError(f"{path}: {rescored.problem}")
            spans = concerning(left_out, path, replay_input.config.site, each.name)
            alarms += sum(not any(span.has(alarm) for span in spans) for alarm in episodes(rescored.alarms))
            fan_samples = rescored.samples * each.fans - rescored.not_judged.total()
            left_out_ns = sum(span.length_ns(rescored.start_ns, rescored.end_ns) for span in spans)
            fan_hours += max(0.0, fan_samples * rescored.period_ns - left_out_ns) / NS_PER_HOUR
    return alarms, fan_hours


def _made_from(path: Path, twin: TrayTwin, calibration: Calibration) -> dict[str, str]:
    """By the hash of each recording that a twin was made from: how, in words."""
    training = json.loads(twin.card_json).get("training", {})
    used = (("trained", training.get("data", ())), ("calibrated", calibration.data))
    return {entry["sha256"]: f"{path} was {verb} on it" for verb, data in used for entry in data}


def _refuse_its_own(path: Path, made_from: dict[str, str]) -> None:
    if how := made_from.get(sha256_of(path)):
        raise UserError(f"{path}: {how}, so it proves nothing: --verify takes other recordings")
