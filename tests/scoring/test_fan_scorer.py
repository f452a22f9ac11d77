"""scoring.fan_scorer: the same verdict however samples are cut, over restarts too; what raises a score and what not."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.messages import Statistic
from scoring.detectors.residual import Residual
from scoring.fan_scorer import FanScorer, Samples, ScoredBlock
from scoring.limits import Limits, ResidualLimits, Timing
from tests.support.healthy_residuals import autoregressive, rows_of, samples_of

FANS = 3
RESIDUAL = ResidualLimits(
    step=6.0,
    drift=10.0,
    growth=1.4,
    usual_growth=0.97,
    reference_sigmas=0.25,
    baseline_sigmas=1.0,
    adaptation_sigmas=0.7,
)
LIMITS = Limits(speed=RESIDUAL, balance=RESIDUAL, stuck_s=2.0)
CURVED = Limits(
    speed=RESIDUAL.model_copy(
        update={"speeds_rad_s": (90.0, 110.0), "offset_sigmas": (0.0, 0.3), "spread": (0.9, 1.2)}
    ),
    balance=RESIDUAL,
    stuck_s=0.3,
    timing=Timing(baseline_s=0.5, adaptation_s=5.0),
)


def white(samples: int, fans: int = FANS, seed: int = 1) -> Samples:
    return samples_of(autoregressive(samples, fans, 0.0, seed), autoregressive(samples, fans, 0.0, seed + 1))


def judged(judge: FanScorer, samples: Samples, cuts: Sequence[int] = ()) -> ScoredBlock:
    edges = [0, *sorted({cut for cut in cuts if 0 < cut < len(samples.t_ns)}), len(samples.t_ns)]
    parts = [judge.update(rows_of(samples, slice(first, last))) for first, last in pairwise(edges)]
    return ScoredBlock(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])})


def assert_same(one: ScoredBlock, other: ScoredBlock) -> None:
    for name in vars(one):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def troubled(samples: int, seed: int) -> Samples:
    """Faults, outliers, readings that miss or repeat themselves, what is not valid, and times that are missing."""
    rng = np.random.default_rng(seed)
    made = white(samples, seed=seed)
    made.speed_residual[samples // 2 :, 0] += rng.choice([0.0, 0.6, 5.0])
    made.balance[samples // 3 :, 1] *= rng.choice([1.0, 2.5])
    made.speed_residual[rng.random(made.speed_residual.shape) < 0.01] = 1e300
    made.speed_residual[rng.random(made.speed_residual.shape) < 0.02] = np.nan
    made.balance[rng.random(made.balance.shape) < 0.02] = np.nan
    hole = rng.integers(samples)
    made.balance[hole : hole + 40, rng.integers(FANS)] = np.nan
    made.speed_rad_s[:] = 100.0 + np.round(5.0 * rng.normal(size=made.speed_rad_s.shape))
    stuck = rng.integers(samples)
    made.speed_rad_s[stuck : stuck + 60, 2] = 77.0
    made.missing[:] = rng.random(made.missing.shape) < 0.02
    made.speed_rad_s[made.missing] = np.nan
    alive = rng.random(made.alive.shape) >= 0.01
    t_ns = made.t_ns + np.where(np.arange(samples) >= rng.integers(samples), rng.integers(3) * 7_000_000_000, 0)
    known = np.isfinite(made.speed_rad_s) & alive
    return replace(
        made,
        t_ns=t_ns,
        alive=alive,
        speed_valid=np.isfinite(made.speed_residual) & known,
        balance_valid=np.isfinite(made.balance) & known,
    )


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 100_000),
    cuts=st.lists(st.integers(1, 399), max_size=10),
    limits=st.sampled_from([LIMITS, CURVED]),
)
def test_cuts_change_no_bit_of_verdicts_and_snapshots(seed: int, cuts: list[int], limits: Limits) -> None:
    samples = troubled(400, seed)
    whole = FanScorer(FANS, limits)
    verdict = judged(whole, samples)
    for each in (cuts, range(400)):
        judge = FanScorer(FANS, limits)
        assert_same(judged(judge, samples, each), verdict)
        assert json.dumps(judge.snapshot()) == json.dumps(whole.snapshot())


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 100_000), cut=st.integers(1, 399))
def test_a_judge_that_is_restored_goes_on_with_the_same_bits(seed: int, cut: int) -> None:
    samples = troubled(400, seed)
    whole, first, second = FanScorer(FANS, CURVED), FanScorer(FANS, CURVED), FanScorer(FANS, CURVED)
    verdict = judged(whole, samples)
    judged(first, rows_of(samples, slice(0, cut)))
    second.restore(json.loads(json.dumps(first.snapshot(), allow_nan=False)))
    after = judged(second, rows_of(samples, slice(cut, 400)))
    assert_same(after, ScoredBlock(**{name: getattr(verdict, name)[cut:] for name in vars(verdict)}))
    assert second.snapshot() == whole.snapshot()


def test_what_is_no_snapshot_of_as_many_fans_is_refused_and_changes_nothing() -> None:
    judge = FanScorer(FANS, LIMITS)
    judged(judge, white(300))
    before = json.dumps(judge.snapshot())
    one = FanScorer(1, LIMITS).snapshot()
    broken = [one, {}, {**judge.snapshot(), "quiet": None}, {**judge.snapshot(), "interval": "x"}]
    for state in broken:
        with pytest.raises((ValueError, KeyError, TypeError)):
            judge.restore(state)
        assert json.dumps(judge.snapshot()) == before


def test_a_fan_is_judged_from_its_first_good_interval_on() -> None:
    verdict = judged(FanScorer(FANS, LIMITS), white(300))
    assert verdict.commissioning[:100].all()
    assert not verdict.commissioning[100:].any()
    assert np.isnan(verdict.score[:100]).all()
    assert np.isfinite(verdict.score[100:]).all()
    assert (verdict.statistic[:100] == Statistic.NONE).all()


def test_a_fans_own_offset_is_its_baseline_and_raises_no_score() -> None:
    samples = white(3000)
    samples.speed_residual[:, 1] += 0.8
    verdict = judged(FanScorer(FANS, LIMITS), samples)
    assert np.nanmax(verdict.score) < 1.0
    np.testing.assert_allclose(verdict.speed_baseline[-1], [0.0, 0.8, 0.0], atol=0.1)


def test_an_offset_beyond_those_of_healthy_fans_raises_the_score_at_once() -> None:
    samples = white(300)
    samples.balance[:, 2] += RESIDUAL.baseline_sigmas + 2.0
    verdict = judged(FanScorer(FANS, LIMITS), samples)
    assert verdict.score[200, 2] > 1.0
    assert verdict.statistic[200, 2] in (Statistic.BALANCE_SMOOTHED, Statistic.BALANCE_DRIFT)
    assert np.nanmax(verdict.score[:, :2]) < 1.0


def speed_up(samples: Samples) -> None:
    samples.speed_residual[:] += 3.0


def more_command(samples: Samples) -> None:
    samples.balance[:] -= 3.0


def slightly_off(samples: Samples) -> None:
    samples.speed_residual[:] += 0.6


def shaken(samples: Samples) -> None:
    samples.balance[:] *= 2.0


def stuck(samples: Samples) -> None:
    samples.speed_rad_s[:] = 50.0


@pytest.mark.parametrize(
    ("change", "statistic"),
    [
        (speed_up, Statistic.SPEED_SMOOTHED),
        (more_command, Statistic.BALANCE_SMOOTHED),
        (slightly_off, Statistic.SPEED_DRIFT),
        (shaken, Statistic.BALANCE_VARIANCE_GROWTH),
        (stuck, Statistic.SENSOR),
    ],
)
def test_each_change_is_found_by_the_statistic_made_for_it(
    change: Callable[[Samples], None], statistic: Statistic
) -> None:
    samples = white(2000)
    change(rows_of(samples, slice(1000, 2000)))
    verdict = judged(FanScorer(FANS, LIMITS), samples)
    assert np.nanmax(verdict.score[:1000]) < 1.0
    for fan in range(FANS):
        above = verdict.score[1000:, fan] > 1.0
        assert statistic in verdict.statistic[1000:, fan][above]


@pytest.mark.parametrize("size", [1e2, 1e6, 1e300])
def test_one_wild_reading_raises_no_alarm_however_wild(size: float) -> None:
    samples = white(2000)
    samples.speed_residual[1000] = samples.balance[1500] = size
    judge = FanScorer(FANS, LIMITS)
    verdict = judged(judge, samples)
    above = verdict.score[1000:] > 1.0
    assert above.sum(axis=0).max() * 0.01 <= LIMITS.timing.on_delay_s
    json.dumps(judge.snapshot(), allow_nan=False)
    assert np.abs(judge.speed.baseline.value).max() < 0.2
    assert np.abs(judge.balance.baseline.value).max() < 0.2


def test_a_healthy_fan_goes_on_to_refine_its_baseline() -> None:
    """The spread of a healthy residual is near its limit all the time, and must not keep it from that."""
    judge = FanScorer(20, LIMITS)
    judged(judge, white(6000, 20))
    assert judge.speed.baseline.intervals.min() > 30
    assert np.abs(judge.speed.baseline.value).max() < 0.06


def test_a_spread_that_is_healthy_again_leaves_its_limit_far_behind() -> None:
    samples = white(3000)
    samples.balance[1000:1500] *= 3.0
    verdict = judged(FanScorer(FANS, LIMITS), samples)
    assert (verdict.score[1500] > 1.0).all()
    assert np.nanmax(verdict.score[2200:]) < 0.75


def far_apart() -> Limits:
    """Limits by which healthy baselines may lie far from none."""
    return LIMITS.model_copy(update={"balance": LIMITS.balance.model_copy(update={"baseline_sigmas": 20.0})})


def test_a_fan_that_is_still_on_its_way_is_not_commissioned_yet() -> None:
    samples = white(2000)
    samples.balance[:180] += np.linspace(15.0, 0.0, 180)[:, np.newaxis]
    verdict = judged(FanScorer(FANS, far_apart()), samples)
    assert (verdict.balance_baseline[:290] == 0.0).all()
    assert np.nanmax(verdict.score) < 1.0


def test_a_first_second_that_holds_still_is_believed_and_what_leaves_it_alarms() -> None:
    samples = white(2000)
    samples.balance[:100] += 3.0
    verdict = judged(FanScorer(FANS, far_apart()), samples)
    assert (np.abs(verdict.balance_baseline[150] - 3.0) < 0.5).all()
    assert (verdict.score[200:] > 1.0).all()


def test_nothing_is_learnt_while_the_score_is_high() -> None:
    samples = white(4000)
    samples.speed_residual[1500:, 0] += 2.0
    judge = FanScorer(FANS, LIMITS)
    verdict = judged(judge, samples)
    np.testing.assert_array_equal(verdict.speed_baseline[1700:, 0], verdict.speed_baseline[1700, 0])
    assert abs(verdict.speed_baseline[-1, 0]) < 0.1


def test_a_fan_is_commissioned_anew_and_the_others_are_left_alone() -> None:
    judge, other = FanScorer(FANS, LIMITS), FanScorer(FANS, LIMITS)
    samples = white(1500)
    samples.speed_residual[500:, 0] += 0.9
    first, rest = rows_of(samples, slice(0, 500)), rows_of(samples, slice(500, 1500))
    judged(judge, first)
    judged(other, first)
    judge.forget(np.array([True, False, False]))
    anew, as_before = judged(judge, rest), judged(other, rest)
    assert np.nanmax(as_before.score[:, 0]) > 1.0
    assert np.nanmax(anew.score[:, 0]) < 1.0
    assert anew.commissioning[0, 0]
    np.testing.assert_array_equal(anew.score[:, 1:], as_before.score[:, 1:])


def test_a_line_that_says_nothing_is_no_verdict_and_a_tacho_that_is_gone_is_one() -> None:
    samples = white(2000)
    samples.alive[500:1000, 0] = False
    samples.missing[500:1000, 1] = True
    samples.speed_rad_s[500:1000, :2] = np.nan
    samples.speed_valid[500:1000, :2] = samples.balance_valid[500:1000, :2] = False
    verdict = judged(FanScorer(FANS, LIMITS), samples)
    assert np.isnan(verdict.score[500:1000, 0]).all()
    assert verdict.score[999, 1] > 1.0
    assert verdict.statistic[999, 1] == Statistic.SENSOR
    assert np.isfinite(verdict.score[1000:]).all()


def test_residuals_are_told_in_sigma_whatever_a_healthy_one_varies_by() -> None:
    wide = LIMITS.model_copy(update={"speed": RESIDUAL.model_copy(update={"spread": (4.0,)})})
    samples = white(3000)
    samples.speed_residual[1000:] += 3.0
    verdict = judged(FanScorer(FANS, wide), samples)
    np.testing.assert_allclose(verdict.speed_smoothed[1200:1500].mean(axis=0), 3.0, atol=0.1)
    judge = FanScorer(FANS, wide)
    assert judge.speed.limit_sigmas(0.01) == pytest.approx(4.0 * judge.balance.limit_sigmas(0.01))


def test_who_watches_sees_how_far_a_drift_goes_beyond_its_limit() -> None:
    samples = white(3000)
    samples.speed_residual[1000:] += 0.6
    judge, watched = FanScorer(FANS, LIMITS), FanScorer(FANS, LIMITS)
    watched.watch()
    verdict = judged(judge, samples)
    assert verdict.score[verdict.statistic == Statistic.SPEED_DRIFT].max() < 1.1
    judged(watched, samples)
    assert watched.watched()[0][Statistic.SPEED_DRIFT - 1].max() > 3.0


def test_an_offset_goes_with_the_speed_as_what_a_little_more_speed_needs_says() -> None:
    # A balance off by a part of the drag, over viscous + 2 drag w, in that at the baseline's speed.
    viscous, drag = 6e-4, 4e-7
    speed = np.array([[50.0, 200.0, 500.0, 900.0]])
    off = drag * speed**2 / (viscous + 2.0 * drag * speed)
    limits = ResidualLimits(baseline_power=2, baseline_speed_rad_s=500.0, baseline_bend_rad_s=viscous / (2.0 * drag))
    found = Residual(4, limits, Timing()).shape(speed, np.ones_like(speed, np.bool_))
    np.testing.assert_allclose(found, off / off[0, 2])
