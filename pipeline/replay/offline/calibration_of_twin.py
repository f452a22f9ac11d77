"""Calibration of a twin by healthy recordings: the priors of its fans, and the limit that keeps a declared rate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.prediction.tray_twin import TrayTwin
from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.reading import read_metadata
from fantwin.pipeline.replay.offline.healthy_runs import DecidedRun, HealthyRuns, LearnedRun, Limit
from fantwin.pipeline.replay.resolve_config import first_raw
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.calibration.calibration import (
    HOURS_PER_DAY,
    Calibration,
    daily_interval,
    expected_alarms,
    is_exceeded,
    least_per_day,
    needed_fan_hours,
    raised_limit,
    supports,
)
from fantwin.scoring.model.learned import learned_priors

LARGEST_PER_DAY = 8640.0
"""that can be declared"""
LARGEST_FACTOR, STEP = 3.0, 1.2
"""times a limit: a statistic that goes further is that of a fault; and by which it is raised above the peaks"""


@dataclass(frozen=True)
class CalibratedTwin:
    """The calibration, and what it follows from."""

    calibration: Calibration
    learned: Sequence[LearnedRun]
    by_theory: Sequence[DecidedRun]
    """the alarms that the limit by theory would have raised"""


def calibration_in(path: Path, twin: TrayTwin) -> Calibration | None:
    """The calibration in a twin's card; None: it has none.

    Raises:
        UserError: it cannot be used.
    """
    if twin.card.calibration is None:
        return None
    try:
        return Calibration.model_validate(twin.card.calibration)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, ("calibration", *first["loc"])))
        raise UserError(f"{path}: its card has {where}: {first['msg']}; calibrate it again") from error


def calibrated(
    runs: HealthyRuns, per_day: float, *, extrapolate: bool = False, alarms_left_out: int = 0
) -> CalibratedTwin:
    """Learn priors, and count the false alarms with them; raise the limit where they are too many.

    per_day: declared, of each fan. extrapolate: also with too few data to show the rate. alarms_left_out: alarms,
    perhaps false ones, whose time is not in the recordings; they count as found.

    Raises:
        UserError: a recording cannot be used, or there are too few for the rate.
    """
    learned = runs.learned()
    fan_hours = sum(run.fan_hours for run in learned)
    if not extrapolate and not supports(fan_hours, per_day):
        raise UserError(too_little(fan_hours, per_day))
    limit = Limit(learned_priors([run.sums for run in learned]), HOURS_PER_DAY * 3600.0 / per_day)
    by_theory = decided = runs.decided(limit)
    expected = expected_alarms(fan_hours, per_day)
    if is_exceeded(_count(decided) + alarms_left_out, fan_hours, per_day):
        limit, decided = _raised(runs, limit, max(int(expected) - alarms_left_out, 0))
    found = _count(decided) + alarms_left_out
    calibration = Calibration(
        false_alarms_per_day=per_day,
        priors=limit.priors,
        limit_factor=limit.factor,
        fan_hours=fan_hours,
        runs=len(learned),
        found=found,
        interval_95=daily_interval(found, fan_hours),
    )
    return CalibratedTwin(calibration, learned, by_theory)


def require_enough(recordings: Sequence[Path], per_day: float) -> None:
    """Raise UserError, before the work, for recordings that cannot show a rate even if all of them counts."""
    fan_hours = math.fsum(map(_longest_fan_hours, recordings))
    if not supports(fan_hours, per_day):
        raise UserError(too_little(fan_hours, per_day))


def _longest_fan_hours(recording: Path) -> float:
    found, first = contents_of(recording), first_raw([recording], read_metadata(recording))
    return (
        sum(raws[0].fans for raws in first.values()) * ((found.last_ns or 0) - (found.first_ns or 0)) / NS_PER_S / 3600
    )


def _raised(runs: HealthyRuns, limit: Limit, most: int) -> tuple[Limit, list[DecidedRun]]:
    """The lowest limit at which the runs have no more alarms, but for faults.

    An excursion may raise more than one. So the alarms themselves are counted, and the limit is raised again until it
    is so.
    """
    peaks = [peak for run in runs.decided(limit.free()) for peak in run.peaks]
    usual = [peak for peak in peaks if peak <= LARGEST_FACTOR]
    allowed = max(most - (len(peaks) - len(usual)), 0)
    factor = raised_limit(usual, allowed)
    while True:
        raised = Limit(limit.priors, limit.declared_s, factor)
        decided = runs.decided(raised)
        count = _count(decided)
        if count <= most or not (allowed or len(usual) == len(peaks)) or factor >= LARGEST_FACTOR:
            return raised, decided
        if allowed:
            allowed = min(allowed - 1, allowed * most // count)
            factor = raised_limit(usual, allowed)
        else:
            factor = min(STEP * factor, LARGEST_FACTOR)


def _count(decided: Sequence[DecidedRun]) -> int:
    return sum(sum(run.alarms) for run in decided)


def too_little(fan_hours: float, per_day: float) -> str:
    """Why so much healthy running cannot show a rate, and what to do."""
    declare = least_per_day(fan_hours)
    instead = f"declare {declare:g} or more, " if declare <= LARGEST_PER_DAY else ""
    return (
        f"{fan_hours:.2g} fan-hours of healthy running cannot show {rate_text(per_day)}: that takes "
        f"{needed_fan_hours(per_day):.3g}; record more, {instead}or add --extrapolate: then it is only a target"
    )


def rate_text(per_day: float) -> str:
    """A rate, for people."""
    return f"{per_day:g} false alarm{'s' * (per_day != 1)} per fan and day"


def number_text(value: float) -> str:
    """Two digits, for people."""
    return f"{value:,.0f}" if value >= 10.0 else f"{value:.2g}"
