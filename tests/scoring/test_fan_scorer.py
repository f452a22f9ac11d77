"""scoring.fan_scorer: cuts and restarts do not change scores; what raises a score and what does not."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.enums import Statistic
from schemas.tacho import Tacho
from schemas.units import NS_PER_S
from scoring.baseline.healthy_residual import HealthyResidual
from scoring.baseline.settings import BaselineSettings
from scoring.baseline.speed_scaling import speed_scaling
from scoring.detectors.detector import DetectorSettings
from scoring.detectors.drift import DriftSettings
from scoring.detectors.smoothed import SmoothedSettings
from scoring.detectors.table import rows
from scoring.detectors.tacho import TachoSettings
from scoring.detectors.variance_growth import VarianceGrowthSettings
from scoring.fan_scorer import FanScorer
from scoring.limits import Limits, Timing
from scoring.samples import Samples
from scoring.scored_block import ScoredBlock
from tests.support.healthy_residuals import autoregressive, rows_of, samples_of

FANS = 3
RESIDUAL = HealthyResidual(baseline=BaselineSettings(commissioning_limit_sigmas=1.0, adaptation_limit_sigmas=0.7))


def detectors(
    stuck_s: float, smoothed: float = 6.0, drift: float = 10.0, reference: float = 0.25, variance: float = 1.4
) -> dict[str, DetectorSettings]:
    kinds: dict[str, DetectorSettings] = {
        "smoothed": SmoothedSettings(limit=smoothed),
        "drift": DriftSettings(limit=drift, reference_sigmas=reference, period_s=0.01),
        "variance_growth": VarianceGrowthSettings(limit=variance, healthy=0.97),
    }
    of_residuals = {f"{source}_{kind}": kinds[kind] for source in ("speed", "balance") for kind in kinds}
    return of_residuals | {"sensor": TachoSettings(stuck_s=stuck_s)}


LIMITS = Limits(speed=RESIDUAL, balance=RESIDUAL, detectors=detectors(2.0))
CURVED = Limits(
    speed=RESIDUAL.model_copy(
        update={
            "speeds_rad_s": (90.0, 110.0),
            "expected_residual_sigmas": (0.0, 0.3),
            "residual_std": (0.9, 1.2),
        }
    ),
    balance=RESIDUAL,
    detectors=detectors(0.3),
    timing=Timing(baseline_s=0.5, adaptation_s=5.0),
)
SHORT_INTERVALS = Limits(
    speed=CURVED.speed.model_copy(
        update={
            "shared_limit": 0.02,
            "baseline": RESIDUAL.baseline.model_copy(
                update={"speed_exponent": 1, "reference_speed_rad_s": 100.0, "ridge": 0.1, "rms_sigmas": 0.2}
            ),
        }
    ),
    balance=RESIDUAL.model_copy(update={"shared_limit": 0.02}),
    detectors=detectors(1e3, smoothed=8.0, drift=60.0, reference=1.0, variance=9.0),
    timing=Timing(baseline_s=0.05, adaptation_s=2.0),
)
"""many intervals in a block: those after commissioning are scored together"""


def white(samples: int, fans: int = FANS, seed: int = 1) -> Samples:
    return samples_of(autoregressive(samples, fans, 0.0, seed), autoregressive(samples, fans, 0.0, seed + 1))


def scored_of(scorer: FanScorer, samples: Samples, cuts: Sequence[int] = ()) -> ScoredBlock:
    edges = [0, *sorted({cut for cut in cuts if 0 < cut < len(samples.t_ns)}), len(samples.t_ns)]
    parts = [scorer.update(rows_of(samples, slice(first, last))) for first, last in pairwise(edges)]
    return ScoredBlock(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])})


def assert_same(one: ScoredBlock, other: ScoredBlock) -> None:
    for name in vars(one):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def troubled(samples: int, seed: int) -> Samples:
    """Faults, outliers, missing and repeated readings, invalid samples, and missing times."""
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


@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 100_000),
    cuts=st.lists(st.integers(1, 399), max_size=10),
    limits=st.sampled_from([LIMITS, CURVED, SHORT_INTERVALS]),
)
def test_cuts_change_no_bit_of_scores_and_snapshots(seed: int, cuts: list[int], limits: Limits) -> None:
    samples = troubled(400, seed)
    whole = FanScorer(FANS, limits)
    scored = scored_of(whole, samples)
    after_gap = (np.flatnonzero(np.diff(samples.t_ns) > NS_PER_S) + 1).tolist()
    for each in ((*cuts, *after_gap, *(row + 1 for row in after_gap)), range(seed % 7, 400, 3)):
        scorer = FanScorer(FANS, limits)
        assert_same(scored_of(scorer, samples, each), scored)
        assert json.dumps(scorer.snapshot()) == json.dumps(whole.snapshot())


@pytest.mark.parametrize("seed", range(2))
def test_intervals_together_give_the_bits_of_one_after_the_other(seed: int) -> None:
    """Speeds that change, fans that turn alone, outliers, and scores around half of their limits."""
    rng = np.random.default_rng(seed)
    one = np.ones((1200, FANS))
    samples = replace(white(1200, seed=seed), speed_sigma_rad_s=one, balance_sigma=one)
    samples.speed_residual[:] += np.repeat(rng.normal(0.0, 0.3, (12, FANS)), 100, axis=0)
    samples.speed_residual[rng.random((1200, FANS)) < 0.003] = 1e3
    samples.speed_rad_s[:] = 100.0 * np.repeat(rng.choice([0.4, 1.0, 1.5], (12, FANS)), 100, axis=0)
    off = np.repeat(rng.random((12, FANS)) < 0.2, 100, axis=0) & (np.arange(1200) >= 100)[:, np.newaxis]
    samples.speed_valid[off] = samples.balance_valid[off] = False
    whole, single = FanScorer(FANS, SHORT_INTERVALS), FanScorer(FANS, SHORT_INTERVALS)
    assert_same(scored_of(whole, samples), scored_of(single, samples, range(0, 1200, 5)))
    assert json.dumps(whole.snapshot()) == json.dumps(single.snapshot())


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 100_000), cut=st.integers(1, 399))
def test_a_restored_scorer_continues_with_the_same_bits(seed: int, cut: int) -> None:
    samples = troubled(400, seed)
    whole, first, second = FanScorer(FANS, CURVED), FanScorer(FANS, CURVED), FanScorer(FANS, CURVED)
    scored = scored_of(whole, samples)
    scored_of(first, rows_of(samples, slice(0, cut)))
    second.restore(json.loads(json.dumps(first.snapshot(), allow_nan=False)))
    after = scored_of(second, rows_of(samples, slice(cut, 400)))
    assert_same(after, ScoredBlock(**{name: getattr(scored, name)[cut:] for name in vars(scored)}))
    assert second.snapshot() == whole.snapshot()


def test_a_snapshot_that_does_not_fit_is_refused_and_changes_nothing() -> None:
    scorer = FanScorer(FANS, LIMITS)
    scored_of(scorer, white(300))
    before = json.dumps(scorer.snapshot())
    one = FanScorer(1, LIMITS).snapshot()
    broken = [one, {}, {**scorer.snapshot(), "within_limit": None}, {**scorer.snapshot(), "interval": "x"}]
    for state in broken:
        with pytest.raises((ValueError, KeyError, TypeError)):
            scorer.restore(state)
        assert json.dumps(scorer.snapshot()) == before


def test_a_fan_has_a_score_from_its_first_good_interval_on() -> None:
    scored = scored_of(FanScorer(FANS, LIMITS), white(300))
    assert scored.commissioning[:100].all()
    assert not scored.commissioning[100:].any()
    assert np.isnan(scored.score[:100]).all()
    assert np.isfinite(scored.score[100:]).all()
    assert (scored.statistic[:100] == Statistic.NONE).all()


def test_a_fans_own_offset_is_its_baseline_and_raises_no_score() -> None:
    samples = white(3000)
    samples.speed_residual[:, 1] += 0.8
    scored = scored_of(FanScorer(FANS, LIMITS), samples)
    assert np.nanmax(scored.score) < 1.0
    np.testing.assert_allclose(scored.speed_baseline[-1], [0.0, 0.8, 0.0], atol=0.1)


def test_an_offset_beyond_those_of_healthy_fans_raises_the_score_at_once() -> None:
    samples = white(300)
    samples.balance[:, 2] += RESIDUAL.baseline.commissioning_limit_sigmas + 2.0
    scored = scored_of(FanScorer(FANS, LIMITS), samples)
    assert scored.score[200, 2] > 1.0
    assert scored.statistic[200, 2] in (Statistic.BALANCE_SMOOTHED, Statistic.BALANCE_DRIFT)
    assert np.nanmax(scored.score[:, :2]) < 1.0


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
    scored = scored_of(FanScorer(FANS, LIMITS), samples)
    assert np.nanmax(scored.score[:1000]) < 1.0
    for fan in range(FANS):
        above = scored.score[1000:, fan] > 1.0
        assert statistic in scored.statistic[1000:, fan][above]


@pytest.mark.parametrize("size", [1e2, 1e300])
def test_one_outlier_raises_no_alarm_however_large(size: float) -> None:
    samples = white(2000)
    samples.speed_residual[1000] = samples.balance[1500] = size
    scorer = FanScorer(FANS, LIMITS)
    scored = scored_of(scorer, samples)
    above = scored.score[1000:] > 1.0
    assert above.sum(axis=0).max() * 0.01 <= LIMITS.timing.on_delay_s
    json.dumps(scorer.snapshot(), allow_nan=False)
    assert np.abs(scorer.residuals["speed"].baseline.value).max() < 0.2
    assert np.abs(scorer.residuals["balance"].baseline.value).max() < 0.2


def test_a_healthy_fan_continues_to_refine_its_baseline() -> None:
    """The deviation of a healthy residual is always near its limit, and must not prevent the refinement."""
    scorer = FanScorer(20, LIMITS)
    scored_of(scorer, white(6000, 20))
    assert scorer.residuals["speed"].baseline.intervals.min() > 30
    assert np.abs(scorer.residuals["speed"].baseline.value).max() < 0.06


def test_a_variance_that_is_healthy_again_falls_well_below_its_limit() -> None:
    samples = white(3000)
    samples.balance[1000:1500] *= 3.0
    scored = scored_of(FanScorer(FANS, LIMITS), samples)
    assert (scored.score[1500] > 1.0).all()
    assert np.nanmax(scored.score[2200:]) < 0.75


def far_apart() -> Limits:
    """Limits with baselines that may be far from zero."""
    wide = RESIDUAL.model_copy(update={"baseline": BaselineSettings(commissioning_limit_sigmas=20.0)})
    return LIMITS.model_copy(update={"balance": wide})


def test_a_fan_that_still_changes_its_speed_is_not_commissioned_yet() -> None:
    samples = white(2000)
    samples.balance[:180] += np.linspace(15.0, 0.0, 180)[:, np.newaxis]
    scored = scored_of(FanScorer(FANS, far_apart()), samples)
    assert (scored.balance_baseline[:290] == 0.0).all()
    assert np.nanmax(scored.score) < 1.0


def test_a_steady_first_second_is_the_baseline_and_leaving_it_alarms() -> None:
    samples = white(2000)
    samples.balance[:100] += 3.0
    scored = scored_of(FanScorer(FANS, far_apart()), samples)
    assert (np.abs(scored.balance_baseline[150] - 3.0) < 0.5).all()
    assert (scored.score[200:] > 1.0).all()


def test_nothing_is_learned_while_the_score_is_high() -> None:
    samples = white(4000)
    samples.speed_residual[1500:, 0] += 2.0
    scorer = FanScorer(FANS, LIMITS)
    scored = scored_of(scorer, samples)
    np.testing.assert_array_equal(scored.speed_baseline[1700:, 0], scored.speed_baseline[1700, 0])
    assert abs(scored.speed_baseline[-1, 0]) < 0.1


def test_one_fan_is_commissioned_again_without_affecting_the_others() -> None:
    scorer, other = FanScorer(FANS, LIMITS), FanScorer(FANS, LIMITS)
    samples = white(1500)
    samples.speed_residual[500:, 0] += 0.9
    first, rest = rows_of(samples, slice(0, 500)), rows_of(samples, slice(500, 1500))
    scored_of(scorer, first)
    scored_of(other, first)
    scorer.recommission(np.array([True, False, False]))
    again, as_before = scored_of(scorer, rest), scored_of(other, rest)
    assert np.nanmax(as_before.score[:, 0]) > 1.0
    assert np.nanmax(again.score[:, 0]) < 1.0
    assert again.commissioning[0, 0]
    np.testing.assert_array_equal(again.score[:, 1:], as_before.score[:, 1:])


def test_a_silent_line_gives_no_score_and_a_missing_tacho_gives_one() -> None:
    samples = white(2000)
    samples.alive[500:1000, 0] = False
    samples.missing[500:1000, 1] = True
    samples.speed_rad_s[500:1000, :2] = np.nan
    samples.speed_valid[500:1000, :2] = samples.balance_valid[500:1000, :2] = False
    scored = scored_of(FanScorer(FANS, LIMITS), samples)
    assert np.isnan(scored.score[500:1000, 0]).all()
    assert scored.score[999, 1] > 1.0
    assert scored.statistic[999, 1] == Statistic.SENSOR
    assert np.isfinite(scored.score[1000:]).all()


def test_an_offset_scales_with_the_speed_as_the_physics_say() -> None:
    # A balance off by a part of the drag, over viscous + 2 drag w, in that at the baseline's speed.
    viscous, drag = 6e-4, 4e-7
    speed = np.array([[50.0, 200.0, 500.0, 900.0]])
    off = drag * speed**2 / (viscous + 2.0 * drag * speed)
    settings = BaselineSettings(
        speed_exponent=2, reference_speed_rad_s=500.0, crossover_speed_rad_s=viscous / (2.0 * drag)
    )
    found = speed_scaling(settings, speed, np.ones_like(speed, np.bool_))
    np.testing.assert_allclose(found, off / off[0, 2])


def test_a_tacho_that_counts_is_not_unsteady_while_its_fan_changes_its_speed() -> None:
    moving = RESIDUAL.model_copy(update={"transient_scale_rad_s": 0.3})
    limits = LIMITS.model_copy(update={"speed": moving})
    block = white(4000)
    rising = np.clip(np.arange(4000) - 2000, 0, 600)[:, np.newaxis] * 0.05
    steps = 4.0 * np.sign(np.sin(np.arange(4000) / 8.0))[:, np.newaxis] * (rising > 4.0) * (rising < 30.0)
    seen = replace(
        block,
        speed_residual=block.speed_residual + steps,
        speed_rad_s=block.speed_rad_s + rising,
        predicted_rad_s=block.predicted_rad_s + rising,
    )
    row = [one.name for one in rows()].index("speed_variance_growth")

    def largest(tacho: Tacho) -> float:
        return float(np.nanmax(FanScorer(FANS, limits, tachos=[tacho]).update(seen).ratios[:, row]))

    assert largest(Tacho()) > 1.0
    assert largest(Tacho(kind="count", window_s=1.0)) < 1.0


def test_limits_widen_while_a_healthy_fan_moves_and_not_while_a_fault_does() -> None:
    moving = RESIDUAL.model_copy(update={"transient_scale_rad_s": 1.0})
    limits = LIMITS.model_copy(update={"speed": moving})
    still = white(3000)
    falling = -np.clip(np.arange(3000) - 2000, 0, 200)[:, np.newaxis] * 0.2
    faulty = replace(still, speed_residual=still.speed_residual + falling, speed_rad_s=still.speed_rad_s + falling)
    predicted = replace(faulty, predicted_rad_s=still.predicted_rad_s + falling)
    commanded = replace(faulty, command=np.where(falling < 0.0, 0.5, 1.0) * still.command)
    row = [one.name for one in rows()].index("speed_smoothed")

    def ratio(samples: Samples) -> float:
        return float(FanScorer(FANS, limits).update(samples).ratios[2100, row].min())

    not_widened = ratio(replace(faulty, speed_rad_s=still.speed_rad_s))
    assert ratio(faulty) == not_widened
    assert ratio(predicted) < 0.5 * not_widened
    assert ratio(commanded) < 0.5 * not_widened
