"""Whether a declared false-alarm rate is kept: counts alarms on other healthy recordings."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from fantwin.pipeline.cli.recordings_in_parallel import RecordingsInParallel
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.prediction.tray_twin import TrayTwin, load_tray_twin
from fantwin.pipeline.recordings.checksum import sha256_of
from fantwin.pipeline.replay.offline.alarm_episodes import episodes
from fantwin.pipeline.replay.offline.calibration_of_twin import calibration_in, number_text
from fantwin.pipeline.replay.offline.healthy_runs import HealthyPart
from fantwin.pipeline.replay.offline.marked_alarms import LeftOut, concerning
from fantwin.pipeline.replay.offline.rescoring import rescore
from fantwin.scoring.calibration.alarm_rate import daily_interval
from fantwin.scoring.calibration.calibration import Calibration, expected_alarms, is_exceeded

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
    pool: RecordingsInParallel,
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
    list(pool.map(partial(_refuse_its_own, made_from=made_from), recordings, "looking for its own recordings"))
    count = partial(_count_alarms, twin=twin, overrides=tuple(overrides), tray=tray, left_out=tuple(left_out))
    counts = list(pool.map(count, recordings, "scoring other healthy recordings"))
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
