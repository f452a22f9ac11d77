"""The residual analysis against residuals of known correlation, with many repetitions to test the stated bounds."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy import signal

from fantwin.twin.evaluation.accuracy import free_run_residuals
from fantwin.twin.evaluation.residual_analysis import ResidualAnalysis, analyse_residual, healthy_residual
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.runs import Array, Run
from tests.support import fan_data

STEP_S = 0.01
SAMPLES = 4000


def times(samples: int) -> Array:
    return np.arange(samples, dtype=np.float64) * STEP_S


def pieces_of(command: Array, lengths: Sequence[int] | None = None) -> list[Run]:
    ends = np.cumsum(lengths if lengths else [len(command)])
    parts = np.split(command, ends[:-1])
    return [Run("piece", times(len(part)), part, np.zeros(len(part))) for part in parts]


def analysed(residual: Array, command: Array, lengths: Sequence[int] | None = None) -> ResidualAnalysis:
    return analyse_residual(residual[:, np.newaxis], pieces_of(command, lengths), settling_s=0.0)[0]


def white(rng: np.random.Generator) -> Array:
    return rng.normal(size=SAMPLES)


def slow(rng: np.random.Generator) -> Array:
    """Autocorrelation exp(-t / 0.5 s)."""
    drawn = rng.normal(size=SAMPLES + 1000)
    return np.asarray(signal.lfilter([1.0], [1.0, -np.exp(-STEP_S / 0.5)], drawn), float)[1000:]


def oscillating(rng: np.random.Generator) -> Array:
    """A resonance at 1 Hz."""
    pole = 0.98 * np.exp(2j * np.pi * STEP_S)
    drawn = rng.normal(size=SAMPLES + 1000)
    return np.asarray(signal.lfilter([1.0], np.poly([pole, pole.conj()]).real, drawn), float)[1000:]


def stairs(rng: np.random.Generator) -> Array:
    return fan_data.stairs(rng, SAMPLES, 1)[:, 0]


def binary(rng: np.random.Generator) -> Array:
    return np.repeat(rng.integers(0, 2, SAMPLES // 10).astype(float), 10)


def test_white_noise_leaves_the_bound_and_fails_the_test_as_often_as_is_said() -> None:
    rng = np.random.default_rng(2)
    analyses = [
        analysed(np.where(rng.random(SAMPLES) < 0.4, np.nan, white(rng)), np.zeros(SAMPLES)) for _ in range(150)
    ]
    assert analyses[0].lags_s[[0, -1]].tolist() == pytest.approx([STEP_S, 5.0])
    outside = [np.abs(analysis.autocorrelation) > analysis.bound_95 for analysis in analyses]
    assert np.mean(outside) == pytest.approx(0.05, abs=0.01)
    p = np.array([analysis.ljung_box_p for analysis in analyses])
    # three standard deviations of a share of 150
    assert np.mean(p < 0.05) == pytest.approx(0.05, abs=0.053)
    assert np.mean(p < 0.5) == pytest.approx(0.5, abs=0.122)


@pytest.mark.parametrize(("residual", "command"), [(slow, stairs), (oscillating, binary)])
def test_unrelated_signals_leave_the_cross_bound_at_5_percent_of_the_lags(
    residual: Callable[[np.random.Generator], Array], command: Callable[[np.random.Generator], Array]
) -> None:
    rng = np.random.default_rng(4)
    outside, largest = [], []
    for _ in range(60):
        analysis = analysed(residual(rng), command(rng))
        outside.append(np.mean(np.abs(analysis.cross_correlation) > analysis.cross_bound_95))
        largest.append(abs(analysis.cross_over_bound))
    assert np.mean(outside) == pytest.approx(0.05, abs=0.02)
    assert np.mean(np.array(largest) > 2.0) < 0.1


def test_a_residual_that_follows_the_command_peaks_at_its_lag_with_its_sign() -> None:
    gain, rng = -0.3, np.random.default_rng(5)
    command = rng.normal(size=SAMPLES)
    analysis = analysed(white(rng) + gain * np.roll(command, 25), command)
    assert analysis.cross_peak_lag_s == pytest.approx(0.25)
    assert analysis.cross_over_bound * gain > 0.0
    assert abs(analysis.cross_over_bound) > 5.0
    peak = analysis.cross_correlation[np.argmin(np.abs(analysis.cross_lags_s - 0.25))]
    assert peak == pytest.approx(gain / np.hypot(1.0, gain), abs=0.05)


def test_a_command_that_answers_the_residual_shows_at_a_negative_lag_and_is_no_fault_of_the_model() -> None:
    rng = np.random.default_rng(6)
    residual = white(rng)
    analysis = analysed(residual, 0.5 * np.roll(residual, 10) + rng.normal(size=SAMPLES))
    assert analysis.cross_lags_s[np.argmax(analysis.cross_correlation)] == pytest.approx(-0.10)
    assert abs(analysis.cross_over_bound) < 2.0


def test_a_model_too_weak_or_too_slow_is_seen_in_its_residual() -> None:
    run = fan_data.published_run(7)

    def judged(**wrong: float) -> ResidualAnalysis:
        parameters = fan_data.published_parameters(**wrong)
        return analyse_residual(free_run_residuals(PhysicalModel(), parameters, [run]), [run])[0]

    good, draggy, heavy = judged(), judged(C_D=0.0027), judged(J=0.18)
    assert good.white
    assert abs(good.cross_over_bound) < 2.0
    assert draggy.white is False
    assert draggy.cross_over_bound > 2.0
    # A fan with less drag than its model is above it.
    assert draggy.mean_rad_s > 3.0 > abs(good.mean_rad_s)
    assert heavy.white is False
    # A heavy model is late: the fan is ahead of it after each step of the command, and not for long.
    assert 0.0 < heavy.cross_peak_lag_s < 0.5
    assert heavy.cross_over_bound > 2.0


def test_the_error_of_the_start_is_not_held_against_the_model() -> None:
    rng = np.random.default_rng(14)
    start = 10.0 * np.exp(-times(SAMPLES) / 0.4)
    residual, (run,) = (white(rng) + start)[:, np.newaxis], pieces_of(stairs(rng))
    assert analyse_residual(residual, [run])[0].white
    assert analyse_residual(residual, [run], settling_s=0.0)[0].white is False
    assert healthy_residual(residual, [run])[0] == pytest.approx((1.0,), rel=0.03)
    assert analyse_residual(residual[:200], [run.rows(0, 200)])[0].samples == 100
    residual[3] = np.inf
    assert np.isnan(analyse_residual(residual, [run])[0].ljung_box_p)


def test_the_count_of_independent_samples_gives_the_scatter_of_the_mean_and_the_autocorrelation_time_is_found() -> None:
    """Also where half of the samples are missing."""
    rng = np.random.default_rng(10)
    drawn = [np.where(rng.random(SAMPLES) < 0.5, np.nan, slow(rng)) for _ in range(150)]
    analyses = [analysed(one, np.zeros(SAMPLES)) for one in drawn]
    claimed = [np.nanstd(one) / np.sqrt(its.independent_samples) for one, its in zip(drawn, analyses, strict=True)]
    assert np.mean(claimed) == pytest.approx(np.std([np.nanmean(one) for one in drawn]), rel=0.2)
    assert np.mean([its.autocorrelation_time_s for its in analyses]) == pytest.approx(0.5, rel=0.15)


def test_the_card_holds_the_tails_of_the_healthy_residual() -> None:
    rng = np.random.default_rng(12)
    residual = np.column_stack((3.0 * rng.normal(size=100_000), rng.normal(size=100_000)))
    residual[::7, 0] = np.nan
    run = Run("long", times(100_000), np.zeros((100_000, 2)), residual)
    sigma_rad_s, card = healthy_residual(residual, [run])
    assert sigma_rad_s == pytest.approx((3.0, 1.0), rel=0.02)
    assert card.quantiles_sigma[0] == pytest.approx((1.96, 2.576, 3.291), rel=0.03)
    assert card.max_sigma[1] == pytest.approx(np.abs(residual[:, 1]).max() / sigma_rad_s[1])
    assert card.autocorrelation_time_s == pytest.approx((STEP_S / 2, STEP_S / 2), rel=0.2)
    assert card.independent_samples[1] == pytest.approx(100_000, rel=0.2)
