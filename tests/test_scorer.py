"""stages.scorer: an alarm needs a lasting excursion, and says when it began."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import accumulate, cycle, pairwise, takewhile
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from pipeline.config import SpeedUnit
from schemas.blocks import cut
from schemas.messages import Alarm, FanState, Prediction, Score, Severity, WhyNot, columns
from stages.scorer import ScorerConfig, ScorerCore

EPOCH_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
SIGMA = 4.0
NORMAL, SUSPECT, ALARM, RETURNING = FanState.NORMAL, FanState.SUSPECT, FanState.ALARM, FanState.RETURNING
Floats = NDArray[np.float64]


def core_of(fans: int = 1, unit: SpeedUnit = "rad/s", **config: float) -> ScorerCore:
    return ScorerCore(fans, unit, ScorerConfig.model_validate(config))


def unsmoothed(unit: SpeedUnit = "rad/s", on_delay_s: float = 0.05, off_delay_s: float = 0.1) -> ScorerCore:
    """Limit 8 rad/s, return below 6."""
    return core_of(unit=unit, smoothing_s=0.0, on_delay_s=on_delay_s, off_delay_s=off_delay_s)


def prediction_of(residual: Floats, valid: NDArray[np.bool_] | None = None, first: int = 0) -> Prediction:
    """Of a twin that says 300 rad/s. residual: (n, fans) or (n,)."""
    residual = residual.reshape(len(residual), -1).astype(float)
    valid = np.ones(residual.shape, np.bool_) if valid is None else valid.reshape(residual.shape)
    return Prediction(
        fans=residual.shape[1],
        step_ns=STEP_NS,
        t_ns=EPOCH_NS + (first + np.arange(len(residual))) * STEP_NS,
        command=np.full(residual.shape, 0.5),
        measured_speed_rad_s=np.where(valid, 300.0 + residual, np.nan),
        predicted_speed_rad_s=np.full(residual.shape, 300.0),
        sigma_rad_s=np.full(residual.shape[1], SIGMA),
        valid=valid,
        why_not=np.where(valid, WhyNot.NONE, WhyNot.GAP).astype(np.uint8),
        twin="t",
    )


def feed(core: ScorerCore, predictions: Iterable[Prediction]) -> tuple[list[Score], list[Alarm]]:
    messages = [message for prediction in predictions for message in core.step(prediction)]
    return [m for m in messages if isinstance(m, Score)], [m for m in messages if isinstance(m, Alarm)]


def states(core: ScorerCore, residual: Sequence[float], valid: Sequence[bool] | None = None) -> list[int]:
    mask = None if valid is None else np.array(valid)
    scores, _ = feed(core, [prediction_of(np.array(residual), mask)])
    return scores[0].state[:, 0].tolist()


def samples(t_ns: int) -> int:
    return (t_ns - EPOCH_NS) // STEP_NS


def test_an_alarm_is_raised_exactly_when_the_on_delay_has_run_out() -> None:
    assert states(unsmoothed(), [0, 0] + [9] * 7) == [NORMAL] * 2 + [SUSPECT] * 5 + [ALARM] * 2
    _, alarms = feed(unsmoothed(), [prediction_of(np.array([0, 0] + [9] * 7))])
    (alarm,) = alarms
    assert (samples(alarm.onset_t_ns), samples(alarm.t_ns)) == (2, 7)
    assert (alarm.active, alarm.severity, alarm.fan) == (True, Severity.ALARM, 0)
    assert (alarm.residual_rad_s, alarm.limit_rad_s) == (9.0, 8.0)


def test_an_excursion_one_sample_too_short_raises_nothing_and_is_counted() -> None:
    core = unsmoothed()
    assert states(core, [0] + [9] * 5 + [0] + [9] * 5 + [0]) == (
        [NORMAL] + [SUSPECT] * 5 + [NORMAL] + [SUSPECT] * 5 + [NORMAL]
    )
    assert core.counters()["excursions_too_short"] == 2


def test_an_excursion_to_either_side_counts_and_crossing_over_does_not_interrupt_it() -> None:
    assert states(unsmoothed(), [9, 9, 9, -9, -9, -9]) == [SUSPECT] * 5 + [ALARM]


def test_the_limit_itself_is_not_exceeded() -> None:
    assert states(unsmoothed(), [8.0] * 10) == [NORMAL] * 10


def test_without_delays_state_follows_at_once() -> None:
    core = unsmoothed(on_delay_s=0, off_delay_s=0)
    assert states(core, [0, 9, 7, 5, 0]) == [NORMAL, ALARM, ALARM, NORMAL, NORMAL]


def test_an_alarm_returns_below_the_deadband_only() -> None:
    assert states(unsmoothed(), [9] * 6 + [7] * 20)[6:] == [ALARM] * 20
    assert states(unsmoothed(), [9] * 6 + [5] * 3)[6:] == [RETURNING] * 3


def test_an_alarm_is_cleared_exactly_when_the_off_delay_has_run_out() -> None:
    residual = np.array([9.0] * 6 + [5.0] * 12)
    assert states(unsmoothed(), residual.tolist())[5:] == [ALARM] + [RETURNING] * 10 + [NORMAL] * 2
    _, (raised, cleared) = feed(unsmoothed(), [prediction_of(residual)])
    assert (cleared.active, samples(cleared.t_ns)) == (False, 16)
    assert cleared.onset_t_ns == raised.onset_t_ns == EPOCH_NS
    assert cleared.limit_rad_s == 6.0


def test_a_return_that_is_interrupted_begins_again() -> None:
    residual = [9.0] * 6 + [5.0] * 10 + [7.0] + [5.0] * 11
    assert states(unsmoothed(), residual)[6:] == [RETURNING] * 10 + [ALARM] + [RETURNING] * 10 + [NORMAL]


def test_samples_that_are_not_valid_freeze_the_on_delay() -> None:
    valid = [True] * 3 + [False] * 40 + [True] * 3
    found = states(unsmoothed(), [9.0] * 46, valid)
    assert found == [SUSPECT] * 3 + [FanState.UNKNOWN] * 40 + [SUSPECT] * 2 + [ALARM]


def test_an_alarm_stays_active_while_nothing_is_known() -> None:
    valid = [True] * 6 + [False] * 200 + [True] * 2
    core = unsmoothed()
    scores, alarms = feed(core, [prediction_of(np.array([9.0] * 6 + [0.0] * 200 + [9.0, 5.0]), np.array(valid))])
    assert scores[0].state[-3:, 0].tolist() == [FanState.UNKNOWN, ALARM, RETURNING]
    assert [alarm.active for alarm in alarms] == [True]
    assert (scores[0].why_not[6:206] == WhyNot.GAP).all()


def test_fans_are_judged_each_for_itself() -> None:
    residual = np.zeros((20, 3))
    residual[5:, 2] = -9
    core = core_of(fans=3, smoothing_s=0, on_delay_s=0.05)
    scores, alarms = feed(core, [prediction_of(residual)])
    assert [alarm.fan for alarm in alarms] == [2]
    assert (scores[0].state[:, :2] == NORMAL).all()


def test_the_residual_is_smoothed_by_the_exact_first_order_low_pass() -> None:
    scores, _ = feed(core_of(), [prediction_of(np.concatenate([[3.0], np.full(100, 10.0)]))])
    elapsed_s = np.arange(101) / 100
    expected = 10 - 7 * np.exp(-elapsed_s / 0.2)
    np.testing.assert_allclose(scores[0].smoothed_residual_rad_s[:, 0], expected, rtol=1e-9)


def test_smoothing_begins_with_the_first_valid_sample_and_is_frozen_by_others() -> None:
    valid = np.array([False, True, False, False, True])
    scores, _ = feed(core_of(), [prediction_of(np.array([50.0, 4.0, 50.0, 50.0, 4.0]), valid)])
    smoothed = scores[0].smoothed_residual_rad_s[:, 0]
    assert np.isnan(smoothed[0])
    np.testing.assert_allclose(smoothed[1:], 4.0)


def test_smoothed_noise_has_the_standard_deviation_the_document_gives() -> None:
    phi, rng = 0.9, np.random.default_rng(5)
    residual = autoregressive(rng, 4000, 64, phi)
    (score,), _ = feed(core_of(fans=64), [prediction_of(residual)])
    a = math.exp(-0.01 / 0.2)
    expected = SIGMA * math.sqrt((1 - a) / (1 + a) * (1 + a * phi) / (1 - a * phi))
    assert score.smoothed_residual_rad_s[500:].std() == pytest.approx(expected, rel=0.02)


def autoregressive(rng: np.random.Generator, n: int, fans: int, phi: float) -> Floats:
    """(n, fans) first-order autoregressive noise with standard deviation SIGMA."""
    noise = rng.normal(0.0, SIGMA, (n, fans))
    for k in range(1, n):
        noise[k] = phi * noise[k - 1] + math.sqrt(1 - phi**2) * noise[k]
    return noise


@pytest.mark.parametrize("phi", [0.0, 0.9])
def test_an_hour_of_a_healthy_fan_leaves_the_band_often_and_raises_nothing(phi: float) -> None:
    residual = autoregressive(np.random.default_rng(11), 60 * 100, 60, phi)  # sixty fans, a minute each
    core = core_of(fans=60)
    scores, alarms = feed(core, [prediction_of(part, first=100 * k) for k, part in enumerate(np.split(residual, 60))])
    outside = sum(int(score.outside.sum()) for score in scores)
    assert outside == pytest.approx(0.0455 * residual.size, rel=0.1)  # some 16,000
    assert alarms == []


def test_a_step_of_three_sigma_raises_within_a_second() -> None:
    rng = np.random.default_rng(3)
    residual = rng.normal(0, SIGMA, (1000, 8))
    residual[500:] += 3 * SIGMA
    _, alarms = feed(core_of(fans=8), [prediction_of(residual)])
    assert sorted(alarm.fan for alarm in alarms) == list(range(8))
    for alarm in alarms:
        assert 500 < samples(alarm.onset_t_ns) < 550
        assert alarm.t_ns - alarm.onset_t_ns == 500_000_000


def eventful_prediction(seed: int, samples: int, change_s: float) -> Prediction:
    """Three fans: residuals that cross the limits, values that are no number, invalid stretches, repeats, jumps."""
    rng = np.random.default_rng(seed)
    shape = (samples, 3)
    k = np.arange(samples)
    level = rng.choice([0.0, 0.0, 5.0, 7.0, 9.0, -12.0], (samples // 5 + 1, 3)).repeat(5, axis=0)[:samples]
    prediction = prediction_of(level + rng.normal(0, 1, shape))
    measured = np.where(rng.random(shape) < 0.02, np.nan, prediction.measured_speed_rad_s)
    predicted = np.where(rng.random(shape) < 0.01, rng.choice([np.nan, np.inf, 1e308, -1e308]), 300.0)
    valid = (rng.random((samples // 7 + 1, 3)) > 0.2).repeat(7, axis=0)[:samples] & (rng.random(shape) > 0.02)
    steps = rng.choice([1, 1, 1, 1, 1, 0, -2, 40], samples) if change_s else np.ones(samples, int)
    return replace(
        prediction,
        t_ns=EPOCH_NS + (steps.cumsum() + k // 50 * round(change_s * 100)) * STEP_NS,
        measured_speed_rad_s=measured,
        predicted_speed_rad_s=predicted,
        valid=valid,
        why_not=np.where(valid, WhyNot.NONE, WhyNot.GAP).astype(np.uint8),
    )


def judged(core: ScorerCore, predictions: Iterable[Prediction]) -> tuple[Any, ...]:
    """All columns, to the bit, and what else the core says; each alarm as it reads."""
    with np.errstate(all="ignore"):
        scores, alarms = feed(core, predictions)
    bits = {name: np.concatenate([getattr(s, name) for s in scores]).tobytes() for name in columns(Score) if scores}
    return bits, [repr(alarm) for alarm in alarms], core.counters(), core.problem()


@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    samples=st.integers(1, 300),
    sizes=st.lists(st.integers(1, 100), min_size=1, max_size=3),
    smoothing_s=st.sampled_from([0.0, 0.02, 0.2]),
    delays_s=st.sampled_from([(0.0, 0.0), (0.03, 0.05), (0.5, 1.0)]),
    change_s=st.sampled_from([0.0, 0.1]),
)
def test_blocks_of_any_size_are_judged_the_same_to_the_bit(
    seed: int, samples: int, sizes: list[int], smoothing_s: float, delays_s: tuple[float, float], change_s: float
) -> None:
    whole = eventful_prediction(seed, samples, change_s)
    ends = [0, *takewhile(lambda end: end < samples, accumulate(cycle(sizes))), samples]
    single, blocks = (
        judged(
            core_of(3, smoothing_s=smoothing_s, on_delay_s=delays_s[0], off_delay_s=delays_s[1], not_judged_s=0.1),
            [cut(whole, *part) for part in pairwise(marks)],
        )
        for marks in (range(samples + 1), ends)
    )
    assert single == blocks


def test_the_made_up_predictions_raise_and_clear_alarms() -> None:
    core = core_of(3, smoothing_s=0.02, on_delay_s=0.03, off_delay_s=0.05)
    judged(core, [eventful_prediction(seed=1, samples=2000, change_s=0.0)])
    assert min(core.counters()[name] for name in ("alarms_raised", "alarms_cleared", "excursions_too_short")) > 10


def test_a_score_carries_all_that_a_viewer_draws() -> None:
    (score,), _ = feed(core_of(), [prediction_of(np.array([0.0, 7.9, 8.1, -8.1]))])
    np.testing.assert_allclose(score.lower_bound_rad_s, 300 - 8.0)
    np.testing.assert_allclose(score.upper_bound_rad_s, 300 + 8.0)
    np.testing.assert_allclose(score.band_variance, 64.0)
    np.testing.assert_allclose(score.residual_rad_s[:, 0], [0.0, 7.9, 8.1, -8.1])
    assert score.outside[:, 0].tolist() == [False, False, True, True]


def test_samples_that_were_judged_are_dropped_and_counted() -> None:
    residual = np.array([0.0] * 5 + [9.0] * 20)
    whole = prediction_of(residual)
    core = unsmoothed()
    _, alarms = feed(core, [prediction_of(residual[:12]), prediction_of(residual[:12]), whole])
    assert [samples(alarm.onset_t_ns) for alarm in alarms] == [5]
    assert core.counters()["repeated"] == 24


def test_a_prediction_that_is_no_number_is_not_judged() -> None:
    prediction = prediction_of(np.zeros(3))
    prediction.predicted_speed_rad_s[1] = np.nan
    (score,), _ = feed(core_of(), [prediction])
    assert score.valid[:, 0].tolist() == [True, False, True]
    assert score.why_not[1, 0] == WhyNot.OUT_OF_RANGE
    assert score.smoothed_residual_rad_s[2, 0] == 0.0


def test_an_alarm_reads_in_the_unit_people_are_shown() -> None:
    _, (below, back) = feed(unsmoothed(), [prediction_of(np.array([-71.2] * 6 + [0.0] * 12))])
    assert below.message == "fan 0: 71 rad/s below the twin for 0.05 s (limit 8)"
    assert back.message == "fan 0: back within 6 rad/s of the twin for 0.1 s"
    _, (above,) = feed(unsmoothed(unit="rpm"), [prediction_of(np.array([100.0] * 6))])
    assert above.message == "fan 0: 955 rpm above the twin for 0.05 s (limit 76)"


def test_another_number_of_fans_is_lost_and_said_to_be() -> None:
    core = core_of(fans=2)
    assert core.step(prediction_of(np.zeros((5, 3)))) == []
    assert core.counters()["lost_wrong_fan_count"] == 5
    assert "fans = 2" in core.problem()


def test_a_deadband_that_no_alarm_could_ever_leave_is_refused() -> None:
    with pytest.raises(ValidationError, match="no alarm could ever clear"):
        ScorerConfig(alarm_sigmas=2.0, deadband_sigmas=2.0)


def unjudged(seconds: float, why: Sequence[WhyNot], first_s: float = 0.0) -> Prediction:
    """Fans that are judged where `why` is NONE."""
    samples = round(seconds * 100)
    valid = np.tile([reason == WhyNot.NONE for reason in why], (samples, 1))
    prediction = prediction_of(np.zeros(valid.shape), valid, first=round(first_s * 100))
    prediction.why_not[:] = np.array(why, np.uint8)
    return prediction


def test_fans_that_are_not_judged_for_long_are_told_with_the_reason_until_they_are_again() -> None:
    core = core_of(fans=4)
    why = [WhyNot.NONE, WhyNot.NO_SPEED, WhyNot.OUT_OF_RANGE, WhyNot.NO_SPEED]
    feed(core, [unjudged(9.99, why)])
    assert core.problem() == ""
    feed(core, [unjudged(0.01, why, first_s=9.99)])
    assert core.problem() == (
        "fan 2 is not judged: the command is out of the twin's range, or a value is no number for 10 s and more; "
        "fans 1, 3 are not judged: no speed for 10 s and more"
    )
    feed(core, [unjudged(15, why, first_s=10)])
    assert "no speed for 20 s and more" in core.problem()
    feed(core, [unjudged(0.01, [WhyNot.NONE] * 4, first_s=25)])
    assert core.problem() == ""


def test_a_first_warm_up_is_not_told_but_one_without_an_end_is() -> None:
    core = core_of()
    feed(core, [unjudged(59.99, [WhyNot.WARMING_UP])])
    assert core.problem() == ""
    feed(core, [unjudged(0.01, [WhyNot.WARMING_UP], first_s=59.99)])
    assert "fan 0 is not judged: the twin is warming up" in core.problem()


def test_a_silent_line_does_not_count_as_not_judged() -> None:
    core = core_of()
    feed(core, [unjudged(1, [WhyNot.NONE]), unjudged(1, [WhyNot.WARMING_UP], first_s=1000)])
    assert core.problem() == ""


def test_another_number_of_fans_is_said_only_until_the_right_one_comes() -> None:
    core = core_of()
    feed(core, [prediction_of(np.zeros((1, 2)))])
    assert "predictions of 2 fans" in core.problem()
    feed(core, [prediction_of(np.zeros(1))])
    assert core.problem() == ""
