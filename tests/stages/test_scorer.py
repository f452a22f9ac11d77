"""stages.scorer: which limits apply, what is emitted, and that cuts into blocks make no difference."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import accumulate, cycle, pairwise, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config.models import TrayConfig
from pipeline.runtime.healthy_twin import HealthyTwin, ScorerConfig, limits_in_force
from pipeline.runtime.stage import Context, StageError
from schemas.blocks import cut
from schemas.enums import Action, FanState, InvalidReason, Severity, Statistic, Transition
from schemas.fields import columns
from schemas.messages import Prediction, Request, Score, ScorerSnapshot
from scoring.detectors.smoothed import SmoothedSettings
from scoring.detectors.tacho import TachoSettings
from scoring.detectors.variance_growth import VarianceGrowthSettings
from scoring.limits import Timing
from scoring.unseen_error import UnseenError
from stages.scorer import NOT_CALIBRATED, STAGE, ScorerCore
from tests.support.scored_blocks import (
    CALIBRATION,
    EPOCH_NS,
    LIVELY,
    SIGMA,
    STEP_NS,
    Floats,
    balance_of_a_fan,
    commissioned,
    core_of,
    feed,
    prediction_of,
    request_of,
    snapshot_of,
)
from tests.support.twin_files import write_twin
from tests.support.uncertainty_tables import by_speed

NORMAL, SUSPECT, ALARM, RETURNING = FanState.NORMAL, FanState.SUSPECT, FanState.ALARM, FanState.RETURNING


def unsmoothed(on_delay_s: float = 0.05, off_delay_s: float = 0.1, **more: Any) -> ScorerCore:
    """Limit 8 rad/s, return below 6; commissioned."""
    return commissioned(core_of(smoothing_s=0.0, on_delay_s=on_delay_s, off_delay_s=off_delay_s, **more))


def states(core: ScorerCore, residual: Sequence[float], valid: Sequence[bool] | None = None) -> list[int]:
    mask = None if valid is None else np.array(valid)
    (score,), _ = feed(core, [prediction_of(np.array(residual), mask)])
    return score.state[:, 0].tolist()


def samples(t_ns: int) -> int:
    return (t_ns - EPOCH_NS) // STEP_NS


# a twin that was not calibrated


def test_an_alarm_is_raised_exactly_at_the_end_of_the_on_delay_and_not_a_sample_before() -> None:
    residual = [0, 0] + [9] * 7
    assert states(unsmoothed(), residual) == [NORMAL] * 2 + [SUSPECT] * 5 + [ALARM] * 2
    _, (alarm,) = feed(unsmoothed(), [prediction_of(np.array(residual))])
    assert (samples(alarm.onset_t_ns), samples(alarm.t_ns)) == (2, 7)
    assert (alarm.active, alarm.severity, alarm.fan) == (True, Severity.WARNING, 0)
    assert (alarm.transition, alarm.statistic) == (Transition.RAISED, Statistic.SPEED_SMOOTHED)
    assert alarm.residual_rad_s == pytest.approx(9.0)
    assert (alarm.limit_rad_s, alarm.score) == (8.0, pytest.approx(9 / 8))
    assert (alarm.acknowledged, alarm.confirmed) == (False, True)
    core = unsmoothed()
    assert states(core, [9] * 5 + [0] + [-9] * 5 + [0]) == ([SUSPECT] * 5 + [NORMAL]) * 2
    assert core.counters()["excursions_too_short"] == 2
    _, worse = feed(unsmoothed(), [prediction_of(np.array([9.0] * 8 + [12.1] * 2))])
    reported = [(each.transition, each.severity) for each in worse]
    assert reported == [(Transition.RAISED, Severity.WARNING), (Transition.SEVERITY, Severity.ALARM)]


def test_an_alarm_clears_below_the_deadband_at_the_end_of_the_off_delay() -> None:
    residual = np.array([9.0] * 6 + [5.0] * 10 + [3.0] * 12)
    assert states(unsmoothed(), residual.tolist())[5:] == [ALARM] * 11 + [RETURNING] * 10 + [NORMAL] * 2
    _, (raised, cleared) = feed(unsmoothed(), [prediction_of(residual)])
    assert (cleared.transition, cleared.active, samples(cleared.t_ns)) == (Transition.CLEARED, False, 26)
    assert cleared.onset_t_ns == raised.onset_t_ns == EPOCH_NS


def test_invalid_samples_pause_the_delays_and_clear_nothing() -> None:
    valid = [True] * 3 + [False] * 40 + [True] * 3
    core = unsmoothed()
    assert states(core, [9.0] * 46, valid) == [SUSPECT] * 3 + [FanState.UNKNOWN] * 40 + [SUSPECT] * 2 + [ALARM]
    (score,), alarms = feed(core, [prediction_of(np.zeros(200), np.zeros(200, np.bool_), first=46)])
    assert Transition.CLEARED not in {alarm.transition for alarm in alarms}
    assert (score.state == FanState.UNKNOWN).all() and (score.invalid_reason == InvalidReason.GAP).all()
    assert np.isnan(score.score).all()


def test_fans_do_not_affect_one_another() -> None:
    residual = np.zeros((20, 3))
    residual[5:, 2] = -9
    core = commissioned(core_of(fans=3, smoothing_s=0, on_delay_s=0.05), fans=3)
    (score,), alarms = feed(core, [prediction_of(residual)])
    assert [alarm.fan for alarm in alarms] == [2]
    assert (score.state[:, :2] == NORMAL).all()


def test_the_residual_is_smoothed_by_the_exact_first_order_low_pass() -> None:
    core = commissioned(core_of())
    (score,), _ = feed(core, [prediction_of(np.full(100, 10.0))])
    baseline = score.speed_baseline_rad_s[0, 0]
    expected = (10 - baseline) * (1 - np.exp(-np.arange(1, 101) / 100 / 0.2))
    np.testing.assert_allclose(score.smoothed_residual_rad_s[:, 0], expected, rtol=1e-9, atol=1e-12)


def test_the_limit_is_in_sigma_at_any_rate_of_the_grid() -> None:
    for period_ns in (STEP_NS // 4, STEP_NS, 5 * STEP_NS):
        core, second = core_of(), 1_000_000_000 // period_ns
        _, none = feed(core, [prediction_of(np.zeros(11 * second), period_ns=period_ns)])
        _, under = feed(core, [prediction_of(np.full(3 * second, 7.9), first=11 * second, period_ns=period_ns)])
        _, over = feed(core, [prediction_of(np.full(3 * second, 8.4), first=14 * second, period_ns=period_ns)])
        assert (none, under) == ([], [])
        assert over[0].transition == Transition.RAISED
        assert over[0].limit_rad_s == pytest.approx(8.0)


def autoregressive(rng: np.random.Generator, n: int, fans: int, phi: float) -> Floats:
    """(n, fans) first-order autoregressive noise with standard deviation SIGMA."""
    noise = rng.normal(0.0, SIGMA, (n, fans))
    for k in range(1, n):
        noise[k] = phi * noise[k - 1] + math.sqrt(1 - phi**2) * noise[k]
    return noise


def test_an_hour_of_a_healthy_fan_leaves_the_band_often_and_raises_nothing() -> None:
    residual = autoregressive(np.random.default_rng(11), 60 * 100, 60, 0.9)  # sixty fans, a minute each
    core = core_of(fans=60, on_delay_s=0.5)
    scores, alarms = feed(core, [prediction_of(part, first=100 * k) for k, part in enumerate(np.split(residual, 60))])
    outside = sum(int(score.outside.sum()) for score in scores)
    assert outside == pytest.approx(0.0455 * residual.size, rel=0.1)  # some 16,000
    assert alarms == []


def test_a_step_of_three_sigma_raises_within_a_second() -> None:
    rng = np.random.default_rng(3)
    residual = rng.normal(0, SIGMA, (1000, 8))
    residual[500:] += 3 * SIGMA
    _, alarms = feed(core_of(fans=8), [prediction_of(residual)])
    assert sorted(alarm.fan for alarm in alarms if alarm.transition == Transition.RAISED) == list(range(8))
    assert all(500 < samples(alarm.onset_t_ns) < 600 for alarm in alarms)


def test_without_a_calibration_torque_balance_and_tacho_judge_nothing_alone() -> None:
    core = commissioned(core_of())
    dead = prediction_of(np.zeros(2000), balance=1000.0, first=500)
    dead.invalid_reason[1000:] = InvalidReason.NO_SPEED
    dead.valid[1000:] = False
    scores, alarms = feed(core, [prediction_of(np.zeros(500), balance=1000.0), dead])
    assert alarms == []
    assert core.problem().startswith("fan 0 is not scored: no speed, for 10 s or more"), "nor may a baseline drift"
    assert scores[0].valid.all() and not scores[1].valid[1000:].any()
    young = prediction_of(np.zeros(20))
    young.valid[:] = False
    young.invalid_reason[:] = InvalidReason.WARMING_UP
    (score,), _ = feed(commissioned(core_of()), [young])
    assert not score.valid.any()
    assert (score.state == FanState.UNKNOWN).all() and (score.invalid_reason == InvalidReason.WARMING_UP).all()


# commissioning


def test_there_is_no_score_before_the_first_baseline() -> None:
    (score,), alarms = feed(core_of(), [prediction_of(np.full(150, 100.0))])
    taken = score.state[:, 0] == FanState.COMMISSIONING
    assert taken[:100].all() and not taken[100:].any()
    assert (score.invalid_reason[:100] == InvalidReason.WARMING_UP).all() and not score.valid[:100].any()
    assert score.valid[100:].all()
    assert len(alarms) == 1, "what was wrong from the beginning is no baseline"


def test_an_offset_becomes_the_baseline_up_to_the_largest_healthy_one_and_at_its_limit_it_is_reported() -> None:
    (score,), _ = feed(core_of(smoothing_s=0.0), [prediction_of(np.full(150, 3.0))])
    np.testing.assert_allclose(score.speed_baseline_rad_s[100:], 3.0, rtol=1e-5)
    np.testing.assert_allclose(score.smoothed_residual_rad_s[100:], 0.0, atol=1e-5)
    assert (score.residual_rad_s == 3.0).all(), "the residual itself is what it is"
    (score,), _ = feed(core_of(), [prediction_of(np.full(150, 30.0))])
    np.testing.assert_allclose(score.speed_baseline_rad_s[100:], SIGMA)
    core = core_of(baseline_s=0.1, adaptation_s=0.5, alarm_sigmas=20.0)
    feed(core, [prediction_of(0.002 * np.arange(5000.0))])
    assert "the baseline of fan 0 is at its adaptation limit" in core.problem()


# a calibrated twin


def calibrated(fans: int = 1, **config: Any) -> ScorerCore:
    return commissioned(core_of(fans, calibration=CALIBRATION, **config), fans)


def noise(samples: int, fans: int = 1, seed: int = 1) -> Floats:
    return np.random.default_rng(seed).normal(0, 0.2 * SIGMA, (samples, fans))


def test_a_fault_that_a_speed_loop_hides_is_found_in_the_torque_balance() -> None:
    extra = np.where(np.arange(300) < 100, 0.0, 10.0)
    scores, alarms = feed(calibrated(), [prediction_of(noise(300), balance=extra)])
    raised = alarms[0]
    assert (raised.transition, raised.statistic) == (Transition.RAISED, Statistic.BALANCE_SMOOTHED)
    assert 100 <= samples(raised.onset_t_ns) <= samples(raised.t_ns) < 130
    assert raised.torque_balance_command == pytest.approx(10.0, rel=0.7)
    assert 0 < raised.torque_balance_limit_command < raised.torque_balance_command
    assert [cause.cause for cause in raised.causes] == ["cannot_tell"], "no other has 15 %"
    assert "takes" in raised.message and "% more than a healthy one" in raised.message
    assert (scores[0].torque_balance_command[150:] == 10.0).all()
    diagnosed = [alarm for alarm in alarms if alarm.transition == Transition.DIAGNOSED]
    assert [round((alarm.t_ns - raised.t_ns) / 1e9, 2) for alarm in diagnosed] == [1.0]


def test_a_tacho_that_repeats_one_reading_or_gives_none_is_found_and_a_silent_link_is_none() -> None:
    _, alarms = feed(calibrated(), [prediction_of(np.full(400, 0.01))])
    assert (alarms[0].statistic, samples(alarms[0].onset_t_ns)) == (Statistic.SENSOR, 201)
    assert alarms[0].message.startswith("fan 0: the tacho repeats one reading, or gives none")
    dead = prediction_of(np.zeros(400), np.zeros(400, np.bool_))
    dead.invalid_reason[:] = InvalidReason.NO_SPEED
    _, alarms = feed(calibrated(), [dead])
    assert alarms[0].statistic == Statistic.SENSOR
    _, alarms = feed(calibrated(), [prediction_of(np.zeros(4000), np.zeros(4000, np.bool_))])
    assert alarms == []


def test_the_torque_balance_counts_while_the_free_run_warms_up() -> None:
    young = prediction_of(noise(300), balance=10.0)
    young.valid[:] = False
    young.invalid_reason[:] = InvalidReason.WARMING_UP
    (score,), alarms = feed(calibrated(), [young])
    assert score.valid.all() and alarms[0].statistic == Statistic.BALANCE_SMOOTHED


def test_a_factor_on_all_limits_makes_alarms_rarer() -> None:
    weak = prediction_of(noise(300), balance=np.where(np.arange(300) < 100, 0.0, 0.8))
    limits = CALIBRATION | {"detectors": {"balance_smoothed": {"limit": 4.0}}}
    _, alarms = feed(commissioned(core_of(calibration=limits)), [weak])
    _, fewer = feed(commissioned(core_of(calibration=limits, limit_factor=3.0)), [weak])
    assert alarms and not fewer


def test_settings_change_the_times_of_the_limits_in_the_card() -> None:
    rate = {
        "false_alarms_per_day": 0.1, "interval_95": (0.05, 0.2), "extrapolated": False, "fan_hours": 9.0, "runs": 3
    }  # fmt: skip
    card = CALIBRATION | {"declared_rate": rate}
    of_card = limits_in_force(ScorerConfig(), card)
    assert of_card.timing == Timing(smoothing_s=0.1, baseline_s=0.5, adaptation_s=30.0, on_delay_s=0.05)
    assert of_card.declared_rate and of_card.declared_rate.runs == 3
    changed = limits_in_force(ScorerConfig(on_delay_s=0.7), card)
    assert changed.timing == Timing(smoothing_s=0.1, baseline_s=0.5, adaptation_s=30.0, on_delay_s=0.7)
    assert changed.declared_rate is None, "it was for other times"
    factor = limits_in_force(ScorerConfig(limit_factor=2.0), card)
    assert factor.settings_of("balance", SmoothedSettings) == SmoothedSettings(limit=8.0)
    assert factor.settings_of("speed", VarianceGrowthSettings) == VarianceGrowthSettings(limit=6.0)
    assert factor.settings_of("tacho", TachoSettings) == TachoSettings(stuck_s=4.0, missing_share=0.5)
    assert factor.declared_rate is None


def context_of(folder: Path, **card: Any) -> Context:
    write_twin(folder / "twin.onnx", **card)
    tray = TrayConfig(name="tray1", fans=2, twin=Path("twin.onnx"))
    return Context("plant", (tray,), ScorerConfig(), folder, folder, 0)


def test_limits_and_balance_come_from_the_twins_card(tmp_path: Path) -> None:
    core = STAGE.build(context_of(tmp_path, calibration=CALIBRATION)).core
    assert isinstance(core, ScorerCore)
    core = commissioned(core, fans=2)
    _, alarms = feed(core, [prediction_of(noise(200, fans=2), balance=10.0)])
    assert {alarm.fan for alarm in alarms} == {0, 1}
    assert "takes" in alarms[0].message and " 1 more than a healthy one" in alarms[0].message, "in the card's unit"
    of_the_only_fan = CALIBRATION | {"speed": {"low_frequency_std_of_fans": [1.0]}}
    assert STAGE.check(context_of(tmp_path, calibration=of_the_only_fan)) == STAGE.check(context_of(tmp_path)) == []


def test_a_calibration_that_cannot_be_used_is_reported_in_one_line(tmp_path: Path) -> None:
    context = context_of(tmp_path, calibration=CALIBRATION | {"detectors": {"speed_smoothed": {"limit": -1.0}}})
    with pytest.raises(StageError) as refused:
        STAGE.build(context)
    assert "calibration cannot be used: detectors: speed_smoothed.limit" in str(refused.value)
    assert "fantwin calibrate" in str(refused.value) and "\n" not in str(refused.value)
    assert STAGE.check(context) == [str(refused.value)]


@pytest.mark.parametrize(
    "speed",
    [
        {"fan_offsets": {"speeds_rad_s": [100.0], "offset_sigmas": [[0.5]] * 3}},
        {"low_frequency_std_of_fans": [1.0, 1.5, 1.0]},
    ],
    ids=str,
)
def test_a_calibration_of_another_number_of_fans_is_reported_in_one_line(tmp_path: Path, speed: dict[str, Any]) -> None:
    context = context_of(tmp_path, calibration=CALIBRATION | {"speed": speed})
    (problem,) = STAGE.check(context)
    assert "its calibration is of 3 fans, the tray has 2; calibrate it again" in problem
    with pytest.raises(StageError, match="calibrate it again"):
        STAGE.build(context)


# requests


def acknowledged(core: ScorerCore, **more: Any) -> list[Any]:
    return [m for m in core.step(request_of(Action.ACKNOWLEDGE, **more)) if not isinstance(m, ScorerSnapshot)]


def test_an_answer_names_its_request_and_the_sample_after_which_it_was_given() -> None:
    core = unsmoothed()
    feed(core, [prediction_of(np.full(10, 9.0))])
    (answer,) = acknowledged(core, producer="operator-7", sequence=3, comment="seen")
    assert (answer.transition, answer.acknowledged, answer.active) == (Transition.ACKNOWLEDGED, True, True)
    assert (answer.request, answer.operator_name, answer.comment) == ("operator-7/3", "Ann", "seen")
    assert samples(answer.t_ns) == 9
    (again,) = acknowledged(core, producer="operator-8")
    assert again.transition == Transition.REFUSED
    assert again.message == "fan 0: refused: it is acknowledged already"
    assert core.counters()["requests"] == 2
    (early,) = acknowledged(core_of())
    assert (early.transition, early.t_ns) == (Transition.REFUSED, 0), "before any sample"


def test_commissioning_takes_a_new_baseline_of_the_fan_it_is_asked_for() -> None:
    core = commissioned(core_of(fans=2, smoothing_s=0.0), fans=2)
    feed(core, [prediction_of(np.full((50, 2), 3.0))])
    _, (answer,) = feed(core, [request_of(Action.COMMISSION, fan=1)])
    assert (answer.fan, answer.transition) == (1, Transition.COMMISSIONING)
    (score,), _ = feed(core, [prediction_of(np.full((250, 2), 3.0), first=50)])
    assert (score.state[:50, 1] == FanState.COMMISSIONING).all()
    assert not (score.state[:, 0] == FanState.COMMISSIONING).any()
    assert score.speed_baseline_rad_s[-1, 1] == pytest.approx(3.0, rel=0.01)
    assert abs(score.speed_baseline_rad_s[-1, 0]) < 3.0, "a mean of what it has always been"


# blocks


def eventful_prediction(seed: int, samples: int, change_s: float) -> Prediction:
    """Three fans: residuals that cross the limits, NaN, invalid stretches, repeats, jumps."""
    rng = np.random.default_rng(seed)
    shape = (samples, 3)
    k = np.arange(samples)

    def levels(*of: float) -> Floats:
        return rng.choice(of, (samples // 5 + 1, 3)).repeat(5, axis=0)[:samples]

    prediction = prediction_of(
        levels(0.0, 0.0, 5.0, 7.0, 9.0, -12.0) + rng.normal(0, 1, shape),
        balance=levels(0.0, 0.0, 1.0, 8.0) + rng.normal(0, 0.3, shape),
    )
    measured = np.where(rng.random(shape) < 0.02, np.nan, prediction.measured_speed_rad_s)
    measured = np.where(levels(0.0, 0.0, 0.0, 1.0) > 0, measured[0], measured)  # stuck for a while
    predicted = np.where(rng.random(shape) < 0.01, rng.choice([np.nan, np.inf, 1e308, -1e308]), 300.0)
    why = (InvalidReason.GAP, InvalidReason.NO_SPEED, InvalidReason.WARMING_UP, InvalidReason.OUT_OF_RANGE)
    valid = (rng.random((samples // 7 + 1, 3)) > 0.2).repeat(7, axis=0)[:samples] & (rng.random(shape) > 0.02)
    steps = rng.choice([1, 1, 1, 1, 1, 0, -2, 40], samples) if change_s else np.ones(samples, int)
    return replace(
        prediction,
        t_ns=EPOCH_NS + (steps.cumsum() + k // 50 * round(change_s * 100)) * STEP_NS,
        measured_speed_rad_s=measured,
        predicted_speed_rad_s=predicted,
        valid=valid,
        invalid_reason=np.where(valid, InvalidReason.NONE, levels(*map(float, why))).astype(np.uint8),
        torque_balance_command=np.where(rng.random(shape) < 0.02, np.nan, prediction.torque_balance_command),
    )


def judged(core: ScorerCore, items: Iterable[Prediction | Request]) -> tuple[Any, ...]:
    """All columns, to the bit, the counters, problem and snapshot of the core, and the repr of each alarm."""
    with np.errstate(all="ignore"):
        scores, alarms = feed(core, items)
    bits = {name: np.concatenate([getattr(s, name) for s in scores]).tobytes() for name in columns(Score) if scores}
    return bits, [repr(alarm) for alarm in alarms], core.counters(), core.problem(), snapshot_of(core).state_json


def parts(whole: Prediction, marks: Iterable[int]) -> list[Prediction]:
    return [cut(whole, *part) for part in pairwise(marks)]


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    samples=st.integers(1, 160),
    sizes=st.lists(st.integers(1, 100), min_size=1, max_size=3),
    smoothing_s=st.sampled_from([0.0, 0.02, 0.2]),
    delays_s=st.sampled_from([(0.0, 0.0), (0.03, 0.05), (0.5, 1.0)]),
    baseline_s=st.sampled_from([0.01, 0.1, 0.33]),
    change_s=st.sampled_from([0.0, 0.1]),
    calibration=st.sampled_from([None, CALIBRATION, LIVELY]),
)
def test_blocks_of_any_size_are_judged_the_same_to_the_bit(
    seed, samples, sizes, smoothing_s, delays_s, baseline_s, change_s, calibration
) -> None:
    whole = eventful_prediction(seed, samples, change_s)
    ends = [0, *takewhile(lambda end: end < samples, accumulate(cycle(sizes))), samples]
    on_delay_s, off_delay_s = delays_s
    single, blocks = (
        judged(
            core_of(
                3,
                calibration=calibration,
                smoothing_s=smoothing_s,
                baseline_s=baseline_s,
                on_delay_s=on_delay_s,
                off_delay_s=off_delay_s,
                not_judged_s=0.1,
            ),
            parts(whole, marks),
        )
        for marks in (range(samples + 1), ends)
    )
    assert single == blocks


# other output


def test_a_score_carries_all_that_a_viewer_draws_and_a_prediction_that_is_no_number_has_none() -> None:
    prediction = prediction_of(np.array([0.0, 7.9, 8.1, -8.1, 0.0]))
    prediction.predicted_speed_rad_s[4] = np.nan
    (score,), _ = feed(commissioned(core_of()), [prediction])
    np.testing.assert_allclose(score.lower_bound_rad_s[:4], 300 - 8.0)
    np.testing.assert_allclose(score.upper_bound_rad_s[:4], 300 + 8.0)
    np.testing.assert_allclose(score.band_variance, 64.0)
    np.testing.assert_allclose(score.residual_rad_s[:4, 0], [0.0, 7.9, 8.1, -8.1])
    assert score.outside[:, 0].tolist() == [False, False, True, True, False]
    assert score.valid[:, 0].tolist() == [True] * 4 + [False]
    assert score.state[4, 0] == FanState.UNKNOWN


def test_repeated_samples_are_dropped_and_counted() -> None:
    residual = np.array([0.0] * 5 + [9.0] * 20)
    whole = prediction_of(residual)
    core = unsmoothed()
    _, alarms = feed(core, [prediction_of(residual[:12]), prediction_of(residual[:12]), whole])
    assert [samples(alarm.onset_t_ns) for alarm in alarms] == [5]
    assert core.counters()["repeated"] == 24


def test_row_13_predictions_that_have_gone_back_for_good_are_reported_until_there_are_new_ones() -> None:
    core = commissioned(core_of())
    feed(core, [prediction_of(np.zeros(500), first=-360_000)])
    assert core.problem() == "", "a producer that was restarted catches up"
    feed(core, [prediction_of(np.zeros(500), first=-359_500)])
    assert core.problem().startswith("predictions are 3590 s older than those before and not judged")
    feed(core, [prediction_of(np.zeros(10))])
    assert core.problem() == ""


def test_an_alarm_reads_in_the_unit_people_are_shown() -> None:
    _, (below, back) = feed(unsmoothed(), [prediction_of(np.array([-71.2] * 6 + [0.0] * 12))])
    assert below.message.startswith("fan 0: 71 rad/s below the twin (limit 8)")
    assert back.message == "fan 0: back to normal"
    _, (above,) = feed(unsmoothed(unit="rpm"), [prediction_of(np.array([100.0] * 6))])
    assert above.message.startswith("fan 0: 955 rpm above the twin (limit 76)")


def test_another_number_of_fans_is_lost_and_reported_until_the_right_one_comes() -> None:
    core = core_of(fans=2)
    assert core.step(prediction_of(np.zeros((5, 3)))) == []
    assert core.counters()["lost_wrong_fan_count"] == 5
    assert core.problem() == "predictions of 3 fans, [[tray]] says fans = 2: correct one of them"
    feed(core, [prediction_of(np.zeros((1, 2)))])
    assert core.problem() == ""


def unjudged(seconds: float, why: Sequence[InvalidReason], first_s: float = 0.0) -> Prediction:
    """Fans that are judged where `why` is NONE."""
    samples = round(seconds * 100)
    valid = np.tile([reason == InvalidReason.NONE for reason in why], (samples, 1))
    prediction = prediction_of(np.zeros(valid.shape), valid, first=round(first_s * 100))
    prediction.invalid_reason[:] = np.array(why, np.uint8)
    return prediction


def test_fans_long_without_a_score_are_reported_with_the_reason() -> None:
    core = commissioned(core_of(fans=4), fans=4)
    why = [InvalidReason.NONE, InvalidReason.NO_SPEED, InvalidReason.OUT_OF_RANGE, InvalidReason.NO_SPEED]
    feed(core, [unjudged(9.99, why)])
    assert core.problem() == ""
    feed(core, [unjudged(0.01, why, first_s=9.99)])
    assert core.problem() == (
        "fan 2 is not scored: the command is outside the twin's range, or a value is not a number, for 10 s or more; "
        "fans 1, 3 are not scored: no speed, for 10 s or more"
    )
    feed(core, [unjudged(15, why, first_s=10)])
    assert "no speed, for 20 s or more" in core.problem()
    feed(core, [unjudged(0.01, [InvalidReason.NONE] * 4, first_s=25)])
    assert core.problem() == ""


def test_a_first_warm_up_is_reported_only_after_a_minute_and_a_silent_line_does_not_count() -> None:
    core = core_of()
    feed(core, [unjudged(59.99, [InvalidReason.WARMING_UP])])
    assert core.problem() == ""
    feed(core, [unjudged(0.01, [InvalidReason.WARMING_UP], first_s=59.99)])
    assert "fan 0 is not scored: the twin is warming up" in core.problem()
    core = commissioned(core_of())
    feed(core, [unjudged(1, [InvalidReason.NONE]), unjudged(1, [InvalidReason.WARMING_UP], first_s=1000)])
    assert core.problem() == ""


@pytest.mark.parametrize("is_wider", [True, False])
def test_the_unseen_error_of_a_twin_widens_band_and_limits(is_wider: bool) -> None:
    table = by_speed((0.0, 600.0), (0.0, 100.0), ((20.0, 20.0), (20.0, 20.0)), 0.0)
    everywhere = UnseenError(table, None, np.array([0.05]), np.array([0.0002]), command_width=100.0)
    limits = limits_in_force(ScorerConfig(), CALIBRATION if is_wider else None)
    twin = HealthyTwin("twin", limits, [balance_of_a_fan()], "%", is_calibrated=is_wider)
    core = ScorerCore(1, "rad/s", ScorerConfig(), replace(twin, unseen_error=everywhere if is_wider else None))
    assert (NOT_CALIBRATED in core.notes()) != is_wider
    noise = np.random.default_rng(1).normal(0.0, SIGMA, 4000)
    noise[2000:] += 20.0
    scores, alarms = feed(core, [prediction_of(noise)])
    half_rad_s = (scores[0].upper_bound_rad_s - scores[0].lower_bound_rad_s) / 2.0
    np.testing.assert_allclose(half_rad_s, 2.0 * (np.hypot(SIGMA, 20.0) if is_wider else SIGMA))
    assert bool(alarms) != is_wider
