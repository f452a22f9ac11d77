"""The mechanisms of `scoring` that can be left out, and what takes their place; see bench.detection.without."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from scoring.detectors.detector import UNREACHED
from scoring.detectors.drift import DEFAULT_REFERENCE_SIGMAS
from scoring.detectors.smoothed import MIN_CAUTIOUS_LIMIT
from scoring.detectors.table import DETECTORS
from scoring.fan_scorer import RESIDUALS

Change = Callable[[Any], Any]


@dataclass(frozen=True)
class Mechanism:
    """One that can be left out. replaced: what stands in for the value at a place, `module:name` or
    `module:class.name`, given that value."""

    name: str
    what: str
    replaced: tuple[tuple[str, Change], ...]


def _by(value: Any) -> Change:
    """This value, whatever was there."""
    return lambda _: value


def _returning(value: Any) -> Change:
    """A function that returns this value, whatever it is given."""
    return lambda _: lambda *_args, **_kwargs: value


def _first_argument(_: Any) -> Any:
    return lambda first, *_args, **_options: first


def _one_spread(over_speed: Any) -> Any:
    def same(*args: Any) -> Any:
        speeds, means, deviations = over_speed(*args)
        return speeds, means, (math.sqrt(float(np.mean(np.square(deviations)))),) * len(speeds)

    return same


def _no_mean(over_speed: Any) -> Any:
    def around_zero(*args: Any) -> Any:
        speeds, means, deviations = over_speed(*args)
        return speeds, (0.0,) * len(speeds), tuple(np.hypot(means, deviations).tolist())

    return around_zero


def _level_over_speed(_: Any) -> Any:
    return lambda _runs, _limits, found, _crossover, **_has_drive: (found, {source: {} for source in RESIDUALS})


def _no_crossover(over_speed: Any) -> Any:
    return lambda runs, limits, found, _, **has_drive: over_speed(runs, limits, found, None, **has_drive)


def _no_ridge(over_speed: Any) -> Any:
    def unshrunk(*args: Any, **has_drive: bool) -> Any:
        found, settings = over_speed(*args, **has_drive)
        return found, {s: {**of, "ridge": 0.0} if "ridge" in of else of for s, of in settings.items()}

    return unshrunk


def _only_commissioning(learn: Any) -> Any:
    return lambda baseline, mean, information, good: learn(
        baseline, mean, information, good & baseline.is_commissioning
    )


def _mean_for_median(_: Any) -> Any:
    def mean(means: Any, weights: Any) -> Any:
        weights = np.where(np.isfinite(means), np.maximum(weights, 1e-12), 0.0)
        return (np.nan_to_num(means) * weights).sum(axis=0) / weights.sum(axis=0)

    return mean


def _off_delay_of_all(holding: Any) -> Any:
    def same(detectors: Any, off_delay_s: float, **options: Any) -> Any:
        rows = holding(detectors, off_delay_s, **options)
        return tuple(replace(one, off_delay_ns=round(off_delay_s * 1e9)) for one in rows)

    return same


def _uncapped(construct: Any) -> Any:
    return lambda drift, settings, context: construct(drift, settings, replace(context, capped=False))


def _plain_reference(prepared: Any) -> Any:
    return lambda settings, evidence: prepared(settings, evidence).model_copy(
        update={"reference_sigmas": DEFAULT_REFERENCE_SIGMAS}
    )


def _without_large_limit(cautious: Any) -> Any:
    """A drift with the sum for small shifts alone."""
    return lambda settings, evidence: cautious(settings, evidence).model_copy(update={"large_limit": None})


def _never_valid(field: str) -> Change:
    def change(stretches: Any) -> Any:
        def silenced(scorer: Any, block: Any, may_span: Any = None) -> Any:
            return stretches(scorer, replace(block, **{field: np.zeros_like(getattr(block, field))}), may_span)

        return silenced

    return change


def _without_row(name: str) -> Change:
    return lambda table: tuple(row for row in table if row.name != name)


def _plain_adaptation_limit(limit_of: Any) -> Any:
    """Where no smoothed residual has a limit, so many of its standard deviations."""

    def limit(residual: Any, source: Any, limits: Any, found: Any) -> Any:
        made = limit_of(residual, source, limits, found)
        if made is not residual:
            return made
        calibration = import_module("scoring.calibration.calibration")
        smoothed_std = calibration.smoothed_std(limits, source, found)
        sigmas = MIN_CAUTIOUS_LIMIT * smoothed_std * residual.mean_residual_std
        return calibration.with_baseline(residual, {"adaptation_limit_sigmas": sigmas})

    return limit


def _none_first(table: Any) -> Any:
    return tuple(replace(row, comes_first=False) for row in table)


def _of_single_readings(_: Any) -> Any:
    return lambda prediction: prediction.measured_speed_rad_s - prediction.predicted_speed_rad_s


_TABLE = "scoring.detectors.table:DETECTORS"
_CALIBRATION = "scoring.calibration.calibration"
_FEW_DATA = "scoring.calibration.few_data"
_VARIATION = "scoring.calibration.healthy_variation"
_BASELINE = "scoring.baseline.baseline"
_SMOOTHED_TOO = "; its limit no longer bounds clipping, drift and adaptation, and persistent-spread goes with it"
_WHAT_DETECTORS = {
    "speed_smoothed": "the detector of steps of the speed" + _SMOOTHED_TOO,
    "speed_drift": "the detector of small shifts of the speed that stay (CUSUM)",
    "speed_variance_growth": "the detector of an unsteady speed",
    "balance_smoothed": "the detector of steps of the torque balance" + _SMOOTHED_TOO,
    "balance_drift": "the detector of small shifts of the torque balance that stay (CUSUM)",
    "balance_variance_growth": "the detector of an unsteady torque balance",
    "sensor": "the detector of readings that repeat or are missing",
    "missing_readings": "the detector of single missing readings, of a loose wire (CUSUM)",
    "standstill": "the detector of fans that stand although they are driven",
    "running_on": "the detector of fans that turn although they are stopped",
}


def _detector(name: str) -> Mechanism:
    extra = ((f"{_CALIBRATION}:_with_adaptation_limit", _plain_adaptation_limit),) if "smoothed" in name else ()
    return Mechanism(name.replace("_", "-"), _WHAT_DETECTORS[name], ((_TABLE, _without_row(name)), *extra))


MECHANISMS: Sequence[Mechanism] = (
    *(_detector(row.name) for row in DETECTORS),
    Mechanism(
        "balance",
        "the torque balance as a whole",
        (("scoring.fan_scorer:FanScorer.stretches", _never_valid("balance_valid")),),
    ),
    Mechanism(
        "speed",
        "the speed residual as a whole",
        (("scoring.fan_scorer:FanScorer.stretches", _never_valid("speed_valid")),),
    ),
    Mechanism(
        "comes-first",
        "standstill is reported before detectors that exceed their limit further",
        ((_TABLE, _none_first),),
    ),
    Mechanism(
        "reading-range",
        "a reading is compared with the range of readings that a counting tacho may show, not with one",
        (("scoring.samples:speed_residual_rad_s", _of_single_readings),),
    ),
    Mechanism(
        "repeats-by-prediction",
        "a repeated reading of a counting tacho counts only where a healthy fan would read something else",
        (("scoring.detectors.tacho:moved", lambda moved: lambda *args: np.ones_like(moved(*args))),),
    ),
    Mechanism(
        "persistent-spread",
        "limits are wider at speeds where the low-frequency residual varies more",
        ((f"{_CALIBRATION}:persistent_std", _returning((1.0,))),),
    ),
    Mechanism(
        "motion",
        "limits are wider while the speed changes",
        (
            (f"{_VARIATION}:_transient_scale_rad_s", _returning(None)),
            (f"{_CALIBRATION}:widened_in_motion", _first_argument),
        ),
    ),
    Mechanism(
        "healthy-motion",
        "they are so only as far as a healthy fan may move, not while a fault stops it",
        (("scoring.detectors.motion:HealthyMotion.update", _returning(math.inf)),),
    ),
    Mechanism(
        "least-time-error",
        "with few data they are so as if the twin were off by 0.2 s and half a period",
        ((f"{_CALIBRATION}:widened_in_motion", _first_argument),),
    ),
    Mechanism(
        "unvisited-speeds",
        "with few data limits are wider at speeds beyond those of calibration",
        ((f"{_FEW_DATA}:wider_at_unvisited_speeds", _first_argument),),
    ),
    Mechanism(
        "expected-residual",
        "the mean healthy residual at each speed is subtracted",
        ((f"{_VARIATION}:_over_speed", _no_mean),),
    ),
    Mechanism(
        "spread-over-speed",
        "the healthy standard deviation is that of each speed",
        ((f"{_VARIATION}:_over_speed", _one_spread),),
    ),
    Mechanism(
        "fan-offsets",
        "the mean healthy residual of each fan at each speed is subtracted",
        ((f"{_CALIBRATION}:fan_offsets", _returning(None)),),
    ),
    Mechanism(
        "counts-in-motion",
        "readings of a tacho that counts may be unsteady while the fan changes its speed",
        (("scoring.interval_scorer:IntervalScorer._unsteadiness", lambda _: lambda _scorer, of: of.standardised),),
    ),
    Mechanism(
        "correlation",
        "units of limits follow from the correlation time of the healthy residual",
        ((f"{_VARIATION}:_autocorrelation_time_s", _returning(0.0)),),
    ),
    Mechanism(
        "clipping",
        "one outlier counts no more than two limits of the smoothed residual",
        (("scoring.residual:Residual._clip", _returning(math.inf)),),
    ),
    Mechanism(
        "bend",
        "baselines grow with a power of the speed",
        ((f"{_CALIBRATION}:baselines_over_speed", _level_over_speed),),
    ),
    Mechanism(
        "crossover",
        "the power of the speed is smaller by one where drag outweighs viscous friction",
        ((f"{_CALIBRATION}:baselines_over_speed", _no_crossover),),
    ),
    Mechanism(
        "ridge",
        "offsets learned at low speed are drawn towards zero",
        ((f"{_CALIBRATION}:baselines_over_speed", _no_ridge),),
    ),
    Mechanism(
        "offset-uncertainty",
        "limits are wider at speeds above those that the baseline was learned at",
        (
            (
                f"{_BASELINE}:Baseline.offset_uncertainty",
                lambda _: lambda _baseline, scaling, *_: np.zeros_like(scaling),
            ),
        ),
    ),
    Mechanism(
        "faster-adaptation",
        "baselines adapt faster to speeds above those that they were learned at",
        ((f"{_BASELINE}:FASTER_INFORMATION", _by(1e300)),),
    ),
    Mechanism(
        "shared-offset",
        "what the fans of a tray have in common is subtracted",
        ((f"{_CALIBRATION}:_with_shared", _first_argument),),
    ),
    Mechanism(
        "adaptation",
        "baselines adapt at all after commissioning",
        ((f"{_BASELINE}:Baseline._learn", _only_commissioning),),
    ),
    Mechanism(
        "adaptation-limit",
        "baselines adapt no further than the limit of the smoothed residual",
        ((f"{_CALIBRATION}:_with_adaptation_limit", _first_argument),),
    ),
    Mechanism(
        "commissioning-limit",
        "the first baseline is no larger than those of healthy runs",
        ((f"{_VARIATION}:_largest_baseline", _returning(UNREACHED)),),
    ),
    Mechanism(
        "commissioning-median",
        "the first baseline is the median of its intervals, not their mean",
        ((f"{_BASELINE}:_weighted_median", _mean_for_median),),
    ),
    Mechanism(
        "movement",
        "fans that change their speed are not commissioned",
        (("scoring.baseline.movement:MAX_MOVING_INTERVALS", _by(0)),),
    ),
    Mechanism(
        "steady-start",
        "the first baseline is that of a steady interval",
        ((f"{_BASELINE}:MAX_UNSTEADY_INTERVALS", _by(0)),),
    ),
    Mechanism(
        "half-limit",
        "commissioned baselines learn only below half of every limit, not below the limit",
        (("scoring.interval_scorer:HALF_LIMIT", _by(1.0)),),
    ),
    Mechanism(
        "no-learning-in-alarm",
        "baselines learn nothing while an alarm is active",
        (("scoring.fan_scorer:FanScorer.learn_nothing", _returning(None)),),
    ),
    Mechanism(
        "gaps",
        "statistics start again after gaps",
        (("scoring.fan_scorer:FanScorer._forget", _returning(None)),),
    ),
    Mechanism(
        "drift-cap",
        "the sum of the drift ends just above its limit",
        (("scoring.detectors.drift:Drift.__init__", _uncapped),),
    ),
    Mechanism(
        "drift-reference",
        "shifts that healthy fans have do not add up to a drift",
        (("scoring.detectors.drift:DriftSettings.prepared", _plain_reference),),
    ),
    Mechanism(
        "cautious",
        "limits from too few healthy data are no closer than a few standard deviations",
        ((f"{_CALIBRATION}:cautious", _first_argument),),
    ),
    Mechanism(
        "large-shifts",
        "with few data and a counting tacho a second sum of the drift finds large shifts sooner",
        (("scoring.detectors.drift:DriftSettings.cautious", _without_large_limit),),
    ),
    Mechanism(
        "mean-over-speeds",
        "from few data no healthy standard deviation is below the mean over the speeds",
        ((f"{_FEW_DATA}:_not_below_mean_over_speeds", _first_argument),),
    ),
    Mechanism(
        "mean-over-fans",
        "from few data limits on slow deviations are not narrower for a fan with little noise",
        ((f"{_FEW_DATA}:_not_below_mean_over_fans", _first_argument),),
    ),
    Mechanism(
        "plateau-end",
        "band and limits are wider around the end of a drive's plateau",
        (("scoring.unseen_error:PLATEAU_END_ERROR", _by(0.0)),),
    ),
    Mechanism(
        "tail-margin",
        "a limit beyond all healthy values is the upper end of its confidence interval",
        (
            (
                "scoring.calibration.tail:Tail.upper_confidence_level",
                lambda _: lambda tail, probability: tail.level(probability),
            ),
        ),
    ),
    Mechanism(
        "worst-fan",
        "healthy runs have no more alarms than declared, whichever fan they are of",
        ((f"{_CALIBRATION}:_with_alarms_at_most", lambda _: lambda _found, factors, _allowed: factors),),
    ),
    Mechanism(
        "return-by-detector",
        "detectors that raised an alarm decide on its return, not the largest ratio of all; the next three go with it",
        (("pipeline.runtime.tray_scorer:holding_detectors", _returning(())),),
    ),
    Mechanism(
        "return-off-delay",
        "an alarm returns after the memory of its detectors, not after the same delay for all",
        (("pipeline.runtime.tray_scorer:holding_detectors", _off_delay_of_all),),
    ),
    Mechanism(
        "return-growth",
        "the longer an alarm has stood, the longer it must be gone",
        (("scoring.alarms.return_rule:LONGEST_RETURN_NS", _by(0)),),
    ),
    Mechanism(
        "return-where-it-shows",
        "only samples at speeds at which it came, or that would show the fault, count for its return",
        (
            ("scoring.alarms.return_rule:_Hold.shows_at", _returning(True)),
            ("scoring.alarms.return_rule:_Hold.is_near", _returning(True)),
        ),
    ),
)
