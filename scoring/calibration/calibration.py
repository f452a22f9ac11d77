"""Limits from healthy runs, such that false alarms are as rare as declared.

A healthy recording is scored like a live fan, with commissioning, baselines and all statistics. For every window of ten
seconds the highest value that each statistic held for the on-delay is kept. The limits by rarity (LimitRule) are set
where these values are equally rare for every statistic, and so rare that alarms, by any statistic, are as frequent as
declared. The ratio of alarms by any statistic to alarms by a single one is counted at lower limits, where alarms are
frequent. An excursion over several windows counts as one alarm. A limit beyond all observed values is set at the upper
end of the confidence interval of the extrapolated tail.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from schemas.messages import Array
from scoring.baseline.fan_offsets import fan_offsets
from scoring.baseline.healthy_residual import HealthyResidual
from scoring.baseline.shared_offset import LEAST_FANS
from scoring.calibration.alarm_rate import rate_interval
from scoring.calibration.evidence import count_std, evidence, smoothed_std
from scoring.calibration.few_data import cautious, widened_in_motion
from scoring.calibration.healthy_statistics import HealthyStatistics, Runs, healthy_statistics, truncate_runs
from scoring.calibration.healthy_variation import (
    UNLIMITED,
    baselines_over_speed,
    persistent_std,
    variation,
    with_baseline,
)
from scoring.calibration.tail import Tail
from scoring.calibration.windows import WindowMaxima, peaks
from scoring.detectors.detector import UNREACHED, DetectorRow, DetectorSettings, LimitRule, Signal
from scoring.detectors.smoothed import SmoothedSettings
from scoring.detectors.table import calibrated_rows
from scoring.fan_scorer import RESIDUALS
from scoring.limits import DeclaredRate, Limits, Timing

DAY_S = 86_400.0
NEEDED_ALARMS = 3.0  # false alarms expected in the healthy runs, for their rate to be distinguished from others
MOST_LEFT_OUT = 2.0 / 3.0  # of the expected alarms: some of those left out were of faults
SURE_ALARMS = 10.0  # of a tacho that counts: limits of fewer have the margins of few data
VARIATION_FAN_S = 5 * DAY_S  # enough to measure how residuals vary; the frequency of large values needs all data
ENOUGH_BLOCKS = 8
MIN_WINDOWS = 6
MIN_S_OF_A_FAN = 60.0  # scored, the mean over fans; with less, limits may be far too narrow: docs/how-to/calibrate.md
WINDOWS_OF_BLOCK = 6  # a minute
MAX_ALARM_SHARE = 0.25  # share of the windows: with more of them the limits would be within the noise
MIN_LEVEL = 0.1 / UNREACHED
SEEN_WINDOWS = 50.0  # with an alarm, to count how often statistics alarm together
SHARED_SHARE = 0.03  # of the speed, or of the command: as the air of a room and a supply vary
MARGIN_ROUNDS = 3  # of scoring the runs with larger limits, at most
ROUNDING = 1e-9


class TooLittleError(Exception):
    """The healthy data cannot support the rate to be declared."""

    def __init__(self, fan_hours: float, needed_fan_hours: float, least_per_day: float) -> None:
        super().__init__(fan_hours, needed_fan_hours)
        self.fan_hours = fan_hours
        self.needed_fan_hours = needed_fan_hours
        self.least_per_day = least_per_day
        """the lowest rate that can be declared with this running"""


def supports(fan_s: float, false_alarms_per_day: float) -> bool:
    """Whether so much healthy running, summed over fans, can support a rate to be declared."""
    return fan_s >= NEEDED_ALARMS * DAY_S / false_alarms_per_day


def too_little(fan_s: float, false_alarms_per_day: float) -> TooLittleError:
    """That so much healthy running cannot support the rate."""
    needed_hours = NEEDED_ALARMS * 24.0 / false_alarms_per_day
    return TooLittleError(fan_s / 3600, needed_hours, NEEDED_ALARMS * DAY_S / max(fan_s, 1.0))


class FragmentedError(Exception):
    """A residual was never scored for a whole second, so nothing is known about how it varies from second to second."""

    def __init__(self, source: Signal, scored_s: float) -> None:
        super().__init__(source, scored_s)
        self.source = source
        self.scored_s = scored_s
        """how long it was scored, summed over fans"""


def calibrate(
    runs: Runs,
    top_speed_rad_s: float,
    timing: Timing,
    false_alarms_per_day: float,
    seed: int = 0,
    extrapolate: bool = False,
    crossover_speed_rad_s: float | None = None,
    has_drive: bool = False,
    sigma_shares: Mapping[Signal, Array] = MappingProxyType({}),
    sigma_rad_s: float | None = None,
    alarms_left_out: int = 0,
    over_predicted_speed: bool = False,
) -> Limits:
    """Limits with a declared number of false alarms per fan and day.

    crossover_speed_rad_s: viscous / (2 drag) of the fans, see scoring.baseline.speed_scaling; None: not known.
    has_drive: the fans have a drive of their own, see twin.models.drive.
    sigma_shares: (fans,) the sigmas of fans that the twin knows one by one, relative to what is the same for all.
    sigma_rad_s: of the speed, the mean over the fans; None: not known.
    alarms_left_out: so many alarms, perhaps false ones, were raised while the runs were recorded, and the time around
    them is not in the runs. Without counting them, each calibration on what was recorded under the limits of the one
    before would have lower limits than that.
    over_predicted_speed: see Limits; for tachos that count.

    Raises:
        TooLittleError: the runs are too short for the rate, and extrapolate is not set; or too short for any limit
            (of each fan, MIN_S_OF_A_FAN).
        FragmentedError: samples are missing in every second.
        MixedRatesError: the runs are not all of one sampling period.
    """
    unlimited = HealthyResidual(baseline=UNLIMITED)
    limits = Limits(
        speed=unlimited,
        balance=unlimited,
        detectors={row.name: row.detector.settings.unreached() for row in calibrated_rows()},
        over_predicted_speed=over_predicted_speed,
        timing=timing,
    )
    found = healthy_statistics(runs, limits, top_speed_rad_s)
    is_enough = supports(found.fan_s, false_alarms_per_day)
    fans = max((run.statistics.shape[2] for run in found.maxima), default=1)
    allows = extrapolate and found.fan_s >= MIN_S_OF_A_FAN * fans
    if found.windows < MIN_WINDOWS or not (is_enough or allows):
        raise too_little(found.fan_s, false_alarms_per_day)
    for source, moments in found.moments.items():
        if moments.count.sum() and not moments.seconds:
            raise FragmentedError(source, float(moments.count.sum()) * found.period_s)
    expected_alarms = false_alarms_per_day * found.fan_s / DAY_S
    left_alarms = expected_alarms - min(alarms_left_out, MOST_LEFT_OUT * expected_alarms)
    target = min(left_alarms / found.windows, MAX_ALARM_SHARE)
    limits = _with(limits, LimitRule.FIXED, lambda row, settings: settings.fixed(found.observed[row.name]))
    limits = _with_shared(limits, found)
    is_long = found.fan_s > VARIATION_FAN_S
    part = truncate_runs(runs, len(found.maxima), VARIATION_FAN_S) if is_long else runs
    limits = _with_variation(part, limits, found, crossover_speed_rad_s, has_drive=has_drive)
    limits = _with_rough_limits(part, limits, target / len(_rows_by_rarity()), top_speed_rad_s)
    found = healthy_statistics(runs, limits, top_speed_rad_s)
    factors = _factors(found, target)
    limits = _scaled(limits, factors)
    if not is_enough or (count_std(limits, found) > 0.0 and expected_alarms < SURE_ALARMS):
        limits = cautious(limits, found, sigma_shares, knows_other_speeds=is_enough)
        if sigma_rad_s is not None:
            limits = widened_in_motion(limits, sigma_rad_s, found.period_s)
        limits, found = _with_declared_alarms(runs, limits, target, top_speed_rad_s)
        factors = np.ones(len(calibrated_rows()))
    rate = DeclaredRate(
        false_alarms_per_day=false_alarms_per_day,
        interval_95=_with_left_out(_interval(found, factors, seed), alarms_left_out, found.fan_s),
        extrapolated=not is_enough,
        fan_hours=found.fan_s / 3600,
        runs=len(found.maxima),
    )
    return Limits.model_validate(limits.model_copy(update={"declared_rate": rate}).model_dump())


def _with_shared(limits: Limits, found: HealthyStatistics) -> Limits:
    """Limits that allow for what fans of one tray share, where there are several."""
    if not any(run.statistics.shape[2] >= LEAST_FANS for run in found.maxima):
        return limits
    command_of_speed = found.command_sum / max(found.speed_sum_rad_s, 1e-9)
    most: dict[Signal, float] = {"speed": SHARED_SHARE, "balance": SHARED_SHARE * command_of_speed}
    return limits.with_residuals(lambda residual, source: residual.model_copy(update={"shared_limit": most[source]}))


def _with_variation(
    runs: Runs, limits: Limits, found: HealthyStatistics, crossover_speed_rad_s: float | None, *, has_drive: bool
) -> Limits:
    """Limits with the variation of the residuals. found: of all runs, with limits that nothing reaches.

    Detectors of a residual that was never valid are not used.
    """
    top_speed_rad_s, moments = found.top_speed_rad_s, found.moments
    offsets = {s: fan_offsets(moments[s].cells, found.centres_rad_s, found.period_s) for s in RESIDUALS}
    limits = limits.with_residuals(lambda residual, s: residual.model_copy(update={"fan_offsets": offsets[s]}))
    if found.fan_s > VARIATION_FAN_S or any(offsets.values()) or limits.speed.shared_limit:
        found = healthy_statistics(runs, limits, top_speed_rad_s)
    found, baselines = baselines_over_speed(runs, limits, found, crossover_speed_rad_s, has_drive=has_drive)

    def varying(_: HealthyResidual, source: Signal) -> HealthyResidual:
        residual = variation(found, source) or HealthyResidual(baseline=UNLIMITED)
        kept = {"fan_offsets": offsets[source], "shared_limit": limits.residual(source).shared_limit}
        return with_baseline(residual, baselines[source]).model_copy(update=kept)

    missing = [source for source in RESIDUALS if not found.moments[source].count.sum()]
    used = {row.name: limits.detectors[row.name] for row in calibrated_rows() if row.source not in missing}
    limits = limits.with_residuals(varying).model_copy(update={"detectors": used})
    seen = healthy_statistics(runs, limits, top_speed_rad_s)
    return limits.with_residuals(
        lambda residual, source: residual.model_copy(
            update={"persistent_std": persistent_std(residual, seen.moments[source], top_speed_rad_s)}
        ),
    )


def _with_rough_limits(runs: Runs, limits: Limits, share: float, top_speed_rad_s: float) -> Limits:
    """Limits by rarity that each statistic alone exceeds in a share of the windows."""
    found = healthy_statistics(runs, limits, top_speed_rad_s)
    limits = _calibrated(limits, found, LimitRule.FIRST, share)
    limits = limits.with_residuals(lambda residual, source: _with_adaptation_limit(residual, source, limits, found))
    limits = _with(limits, LimitRule.RARITY, lambda row, now: now.prepared(evidence(row, limits, found)))
    found = healthy_statistics(runs, limits, top_speed_rad_s)
    return _calibrated(limits, found, LimitRule.RARITY, share)


def _calibrated(limits: Limits, found: HealthyStatistics, rule: LimitRule, share: float) -> Limits:
    level = {row.name: _level(found, number, share) for number, row in enumerate(calibrated_rows())}
    return _with(limits, rule, lambda row, now: now.calibrated(level[row.name], evidence(row, limits, found)))


def _with_adaptation_limit(
    residual: HealthyResidual, source: Signal, limits: Limits, found: HealthyStatistics
) -> HealthyResidual:
    """A baseline may adapt as far as the limit of the smoothed residual."""
    smoothed = limits.settings_of(source, SmoothedSettings)
    if smoothed is None:
        return residual
    limit = smoothed.limit * smoothed_std(limits, source, found) * residual.mean_residual_std
    return with_baseline(residual, {"adaptation_limit_sigmas": limit})


def _with(
    limits: Limits, rule: LimitRule, change: Callable[[DetectorRow, DetectorSettings], DetectorSettings]
) -> Limits:
    """Limits with other settings of the detectors of a rule."""
    detectors = {
        row.name: change(row, limits.detectors[row.name])
        if row.detector.settings.rule is rule
        else limits.detectors[row.name]
        for row in calibrated_rows()
        if row.name in limits.detectors
    }
    return limits.model_copy(update={"detectors": detectors})


def _scaled(limits: Limits, factors: Array) -> Limits:
    """Limits times the factors of the rows of the table."""
    return limits.scaled(dict(zip((row.name for row in calibrated_rows()), factors.tolist(), strict=True)))


def _allowed(found: HealthyStatistics, target: float) -> int:
    """How many alarms these runs may have, if a share `target` of the windows may have one."""
    return int(target * found.windows + ROUNDING)


def _factors(found: HealthyStatistics, target: float) -> Array:
    """(rows of the table,) factors on the limits, with which a share `target` of the windows has an alarm."""
    count = len(_rows_by_rarity())
    often = min(max(target, SEEN_WINDOWS / found.windows), MAX_ALARM_SHARE)
    at = np.array([_level(found, number, often / count) for number in range(len(calibrated_rows()))])
    together = np.concatenate([peaks(_score(run, at)).ravel() for run in found.maxima])
    passed = float((together[np.isfinite(together)] > 1.0).mean())
    independent = min(
        max(passed / (often / count), 1.0), float(count)
    )  # the equivalent number of independent statistics
    factors = [
        1.0 if row.detector.settings.rule is LimitRule.FIXED else _level(found, number, target / independent)
        for number, row in enumerate(calibrated_rows())
    ]
    return _with_alarms_at_most(found, np.array(factors), _allowed(found, target))


def _with_alarms_at_most(found: HealthyStatistics, factors: Array, allowed: int) -> Array:
    """Factors with which these runs have no more alarms than allowed; a tail over many fans ignores the worst fan.

    The limit that raises most alarms is increased beyond a few excursions at a time.
    """
    factors = factors.copy()
    by_rarity = _rows_by_rarity()
    while True:
        too_many = sum(int((peaks(_score(run, factors)) > 1.0).sum()) for run in found.maxima) - allowed
        excursions = {
            number: np.concatenate([peaks(run.statistics[:, number] / factors[number]).ravel() for run in found.maxima])
            for number in by_rarity
        }
        beyond = {number: np.sort(of[of > 1.0]) for number, of in excursions.items()}
        most = max(by_rarity, key=lambda number: len(beyond[number]))
        if too_many <= 0 or not len(beyond[most]):
            return factors
        at_once = min(max(too_many // len(by_rarity), 1), len(beyond[most]))
        factors[most] *= beyond[most][at_once - 1] * (1.0 + ROUNDING)


def _with_declared_alarms(
    runs: Runs, limits: Limits, target: float, top_speed_rad_s: float
) -> tuple[Limits, HealthyStatistics]:
    """Limits with margins, increased where the runs would have more alarms than allowed; and what the runs then show.

    Margins change reference values, which limits by rarity say nothing about. Larger limits let baselines learn more,
    so the runs are scored with them again.
    """
    ones = np.ones(len(calibrated_rows()))
    found = healthy_statistics(runs, limits, top_speed_rad_s)
    for _ in range(MARGIN_ROUNDS):
        factors = _with_alarms_at_most(found, ones, _allowed(found, target))
        if (factors == 1.0).all():
            break
        limits = _scaled(limits, factors)
        found = healthy_statistics(runs, limits, top_speed_rad_s)
    return limits, found


def _rows_by_rarity() -> list[int]:
    """The numbers of the calibrated rows whose limits share the declared rate."""
    return [number for number, row in enumerate(calibrated_rows()) if row.detector.settings.rule is not LimitRule.FIXED]


def _level(found: HealthyStatistics, row: int, share: float) -> float:
    """The value that a statistic exceeds in a share of the windows, in multiples of its limit."""
    seen = found.peaks(row)
    tail = Tail.fit(seen, share)
    is_beyond = share * len(seen) < 1.0
    return max(tail.upper_confidence_level(share) if is_beyond else tail.level(share), MIN_LEVEL)


def _with_left_out(interval: tuple[float, float], alarms: int, fan_s: float) -> tuple[float, float]:
    """The interval of a rate, a day, if as many alarms that were left out were false, or none of them."""
    return interval[0], interval[1] + alarms * DAY_S / fan_s


def _score(run: WindowMaxima, factors: Array) -> Array:
    """(windows, fans) the score with limits times their factors."""
    return (run.statistics / factors[:, np.newaxis]).max(axis=1)


def _interval(found: HealthyStatistics, factors: Array, seed: int) -> tuple[float, float]:
    """95 % interval of the alarms per fan and day, with limits times their factors.

    Alarms are counted in independent blocks: whole runs if there are enough, else fans of runs, else minutes.
    """
    window_days = found.fan_s / found.windows / DAY_S
    raised = [peaks(_score(run, factors)) > 1.0 for run in found.maxima]
    scored = [np.isfinite(run.score) for run in found.maxima]
    blocks = list(zip(raised, scored, strict=True))
    if len(blocks) < ENOUGH_BLOCKS:
        blocks = [(alarms.T[k], seen.T[k]) for alarms, seen in blocks for k in range(alarms.shape[1])]
    if len(blocks) < ENOUGH_BLOCKS:
        blocks = [
            (alarms[k : k + WINDOWS_OF_BLOCK], seen[k : k + WINDOWS_OF_BLOCK])
            for alarms, seen in blocks
            for k in range(0, len(alarms), WINDOWS_OF_BLOCK)
        ]
    blocks = [(alarms, seen) for alarms, seen in blocks if seen.any()]
    counts = np.array([alarms.sum() for alarms, _ in blocks], np.float64)
    days = np.array([seen.sum() for _, seen in blocks]) * window_days
    return rate_interval(counts, days, seed)
