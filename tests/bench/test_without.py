"""Each mechanism that the bench can leave out exists, and a small tray is judged or calibrated otherwise without it."""

from __future__ import annotations

import gc
from collections.abc import Callable, Hashable
from dataclasses import replace
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from bench.detection import run
from bench.detection.mechanisms import MECHANISMS, Mechanism
from bench.detection.without import NOTHING, UnknownMechanismError, owner_of, without
from pipeline.runtime.healthy_twin import HealthyTwin, ScorerConfig, limits_in_force
from schemas.enums import InvalidReason
from schemas.messages import Alarm, Array, Prediction, Score
from schemas.standstill import Standstill
from schemas.tacho import Tacho
from schemas.twin_card import DriveCard
from scoring.calibration.healthy_statistics import HealthyRun
from scoring.detectors.detector import Signal
from scoring.diagnosis.diagnoser import Diagnoser
from scoring.fan_scorer import RESIDUALS, FanScorer
from scoring.limits import Limits, Timing
from scoring.samples import samples_of
from scoring.unseen_error import UnseenError
from stages.scorer import ScorerCore
from tests.support.calibrated_runs import calibrate
from tests.support.healthy_residuals import autoregressive
from tests.support.scored_blocks import balance_of_a_fan

FANS, PERIOD_S, TOP_RAD_S = 6, 0.5, 600.0
TIMING = Timing(smoothing_s=1.0, baseline_s=5.0, adaptation_s=40.0, on_delay_s=0.5)
TACHO = Tacho(kind="count", window_s=1.0)
ONLY = np.eye(FANS)
SPANS = {"repeats": (40, 50), "lapses": (60, 66), "gap": (150, 175), "stands": (90, 100), "runs on": (120, 130)}
"""s"""
STANDSTILL = Standstill(turning_command=20.0, standing_below_rad_s=30.0, off_command=0.0, start_s=1.0, coast_s=2.0)


def speeds(seconds: float, seed: int) -> Array:
    """(n, FANS) speeds that are held for a while and then change, rad/s."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, seconds, PERIOD_S)
    at_s = np.arange(0.0, seconds + 12.0, 12.0)
    levels = rng.uniform(0.2, 0.9, (len(at_s), FANS)) * TOP_RAD_S
    before = np.minimum(np.searchsorted(at_s, t_s, side="right") - 1, len(at_s) - 2)
    moved = np.minimum((t_s - at_s[before]) / 3.0, 1.0)[:, np.newaxis]
    return levels[before] + moved * (levels[before + 1] - levels[before])


def prediction(
    speed_rad_s: Array,
    seed: int,
    speed: Array | float = 0.0,
    balance: Array | float = 0.0,
    *,
    is_one_worse: bool = False,
) -> Prediction:
    """A run of a healthy tray on a day of its own, with deviations added; sigma is one. is_one_worse: large deviations
    of one fan are far more frequent."""
    rng = np.random.default_rng(seed)
    relative, ramps = speed_rad_s / TOP_RAD_S, np.gradient(speed_rad_s, axis=0)
    fans = np.arange(FANS)

    def residual(seed: int) -> Array:
        noise = autoregressive(len(speed_rad_s), FANS, 1.0, seed, PERIOD_S) * (0.5 + relative)
        noise[:, 5] **= 3 if is_one_worse else 1
        day, fan = 3.0 * rng.normal() * relative**2, np.sin(fans + 6.0 * relative)
        return noise + day + fan + 2.0 * relative + 0.02 * ramps

    measured = speed_rad_s + residual(2 * seed + 1) + speed
    shape = speed_rad_s.shape
    return Prediction(
        fans=FANS,
        period_ns=round(PERIOD_S * 1e9),
        t_ns=1_700_000_000_000_000_000 + np.arange(shape[0]) * round(PERIOD_S * 1e9),
        command=speed_rad_s / 6.0,
        measured_speed_rad_s=measured,
        predicted_speed_rad_s=speed_rad_s,
        sigma_rad_s=np.ones(FANS),
        valid=np.ones(shape, np.bool_),
        invalid_reason=np.zeros(shape, np.uint8),
        torque_balance_command=residual(2 * seed + 2) + balance,
        torque_balance_sigma_command=np.ones(FANS),
        reading_range_rad_s=np.full(shape, 0.3),
    )


@cache
def healthy(runs: int, seconds: float, *, is_one_worse: bool) -> list[HealthyRun]:
    every = [prediction(speeds(seconds, seed), seed, is_one_worse=is_one_worse) for seed in range(runs)]
    made = [samples_of(one) for one in every]
    return [HealthyRun(str(seed), FANS, [block], range(FANS), (TACHO,)) for seed, block in enumerate(made)]


def limits_of(
    runs: int, seconds: float, per_day: float, *, extrapolate: bool = False, is_one_worse: bool = False
) -> Limits:
    every = healthy(runs, seconds, is_one_worse=is_one_worse)
    shares: dict[Signal, Array] = {source: np.linspace(0.01, 0.03, FANS) for source in RESIDUALS}
    return calibrate(
        lambda: every, TOP_RAD_S, TIMING, per_day, 0, extrapolate, 100.0, sigma_shares=shares, sigma_rad_s=0.5
    )


@cache
def faulty() -> Prediction:
    """A step, a slow growth, an unsteady fan, a tacho that repeats and lapses, a gap, one that stands or runs on."""
    speed_rad_s = speeds(200.0, 50)
    t_s = (np.arange(len(speed_rad_s)) * PERIOD_S)[:, np.newaxis]
    fault = np.where((t_s > 80.0) & (t_s < 140.0), 1.0, 0.0)
    unsteady = np.where(t_s < 10.0, 1.0, fault) * np.random.default_rng(51).normal(size=speed_rad_s.shape)
    of_speed = -40.0 * fault * ONLY[0] + 6.0 * fault * ONLY[1] + 15.0 * unsteady * ONLY[2]
    of_balance = 15.0 * fault * ONLY[1] - 40.0 * fault * ONLY[3] + 15.0 * unsteady * ONLY[4]
    made = prediction(speed_rad_s, 52, of_speed, of_balance)
    during = {name: slice(*(np.array(span) / PERIOD_S).astype(int)) for name, span in SPANS.items()}
    made.measured_speed_rad_s[during["repeats"], 3] = made.measured_speed_rad_s[during["repeats"].start, 3]
    made.measured_speed_rad_s[during["lapses"], 3] = np.nan
    made.invalid_reason[during["lapses"], 3] = InvalidReason.NO_SPEED
    made.invalid_reason[during["gap"], 0] = InvalidReason.GAP
    made.measured_speed_rad_s[during["stands"], 5] = 0.0
    made.command[during["runs on"], 5] = 0.0
    made.invalid_reason[during["runs on"], 5] = InvalidReason.STOPPED
    return replace(made, valid=made.invalid_reason == InvalidReason.NONE)


def judged(limits: Limits, unseen_error: UnseenError | None = None) -> Hashable:
    """All that a scorer says about the faulty run."""
    config = ScorerConfig(off_delay_s=1.0, deadband=0.25)
    every = limits_in_force(config, limits.model_dump(), STANDSTILL)
    balances = [balance_of_a_fan()] * FANS
    twin = HealthyTwin("", every, balances, "", (TACHO,) * FANS, STANDSTILL, unseen_error=unseen_error)
    core = ScorerCore(FANS, "rpm", config, twin)
    said: list[Hashable] = []
    with patch.object(Diagnoser, "diagnose", return_value=()):  # which takes most of the time
        messages = core.step(faulty())
    for message in messages:
        if isinstance(message, Score):
            said.append((message.score.tobytes(), message.statistic.tobytes(), message.state.tobytes()))
        elif isinstance(message, Alarm):
            said.append((message.t_ns, message.fan, message.transition))
    return tuple(said)


@cache
def far_limits() -> Limits:
    """Limits that only faults reach, of the decision as it is."""
    return limits_of(3, 60.0, 3000.0).times(2.5)


def is_changed(probe: Callable[[], Hashable], name: str) -> bool:
    """Whether the probe gives another result without a mechanism."""
    before = as_it_is(probe)
    with without(name):
        return probe() != before


@cache
def as_it_is(probe: Callable[[], Hashable]) -> Hashable:
    return probe()


def decisions() -> Hashable:
    return judged(far_limits())


def decisions_behind_a_drive() -> Hashable:
    """Plateaus end in the middle of the commands."""
    drive = DriveCard(turning_command=20.0, kick_s=0.5, rest_s=1.0, lowest_command=(50.0,) * FANS)
    slope = np.full(FANS, 1.0 / 6.0)
    return judged(far_limits(), UnseenError(None, drive, slope, np.zeros(FANS), command_width=1000.0))


def limits() -> Hashable:
    return limits_of(3, 60.0, 3000.0).model_dump_json()


def extrapolated_limits() -> Hashable:
    return limits_of(3, 60.0, 10.0, extrapolate=True).model_dump_json()


def limits_of_many_runs() -> Hashable:
    return limits_of(12, 20.0, 3000.0).model_dump_json()


def limits_with_one_worse() -> Hashable:
    return limits_of(3, 60.0, 3000.0, is_one_worse=True).model_dump_json()


PROBES: dict[str, Callable[[], Hashable]] = {
    "fan-offsets": limits_of_many_runs,
    "worst-fan": limits_with_one_worse,
    "cautious": extrapolated_limits,
    "large-shifts": extrapolated_limits,
    "mean-over-speeds": extrapolated_limits,
    "mean-over-fans": extrapolated_limits,
    "least-time-error": extrapolated_limits,
    "unvisited-speeds": extrapolated_limits,
    "tail-margin": extrapolated_limits,
    "plateau-end": decisions_behind_a_drive,
}


def probe_of(mechanism: Mechanism) -> Callable[[], Hashable]:
    """What shows that it is left out."""
    places = [place for place, _ in mechanism.replaced]
    of_limits = any(
        place.startswith(("scoring.calibration", "scoring.detectors.drift:DriftSettings")) for place in places
    )
    is_calibrated = of_limits or mechanism.name.partition("-")[2] in ("smoothed", "drift", "variance-growth")
    of_tacho = mechanism.name in ("sensor", "missing-readings")
    return PROBES.get(mechanism.name, limits if is_calibrated or of_tacho else decisions)


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_without_a_mechanism_something_is_decided_otherwise(mechanism: Mechanism) -> None:
    for place, _ in mechanism.replaced:
        owner, attribute = owner_of(place)
        assert attribute in vars(owner), place
    assert is_changed(probe_of(mechanism), mechanism.name)


def test_names_are_unique_and_an_unknown_one_is_refused() -> None:
    assert len({one.name for one in MECHANISMS}) == len(MECHANISMS)
    with pytest.raises(UnknownMechanismError, match="--without list"), without("no-such"):
        pass


def test_afterwards_everything_is_as_before() -> None:
    places = [owner_of(place) for one in MECHANISMS for place, _ in one.replaced]
    before = [vars(owner)[attribute] for owner, attribute in places]
    with without(NOTHING, *(one.name for one in MECHANISMS)):
        assert all(
            vars(owner)[attribute] is not value for (owner, attribute), value in zip(places, before, strict=True)
        )
    assert all(vars(owner)[attribute] is value for (owner, attribute), value in zip(places, before, strict=True))


def test_the_bench_does_without_it_for_as_long_as_tables_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[object] = []

    def tables(*_args: object, **_options: object) -> tuple[dict[str, Any], list[str]]:
        gc.collect()
        seen.append(FanScorer.learn_nothing)
        return {}, []

    whole = FanScorer.learn_nothing
    monkeypatch.setattr(run, "measured_tables", tables)
    for names in (None, ["no-learning-in-alarm"]):
        run.main(only="measured", without_names=names)
    assert seen[0] is whole and seen[1] is not whole
    assert FanScorer.learn_nothing is whole
