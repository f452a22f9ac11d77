"""The figures, against residuals that are known."""

import fan_data
import numpy as np
import pytest

from twin.build import evaluate, train_twin
from twin.errors import TwinError
from twin.evaluation import evaluate_model, free_run_residuals, healthy_sigma_rad_s
from twin.physical import PhysicalModel
from twin.runs import Run

PARAMETERS = fan_data.PUBLISHED_PARAMETERS[None]
SIGMA = np.array([fan_data.NOISE_RAD_S])


@pytest.fixture(scope="module")
def run() -> Run:
    return fan_data.published_run(21, 30.0)


def test_the_true_model_leaves_the_noise_and_two_sigma_cover_95_percent(run: Run) -> None:
    figures = evaluate_model(PhysicalModel(), PARAMETERS, SIGMA, [run]).pooled
    assert figures.rmse_rad_s == pytest.approx(fan_data.NOISE_RAD_S, rel=0.05)
    assert figures.coverage_2_sigma == pytest.approx(0.954, abs=0.02)
    assert figures.r2 > 0.99
    assert figures.samples == run.samples


def test_r2_is_zero_for_a_model_as_good_as_the_mean() -> None:
    still = np.array([[1.0, 1e-9, 0.0]])
    speed = np.tile([5.0, 5.0, 5.0, 5.0, 5.0, 4.0, 6.0], 10)
    run = Run("flat", np.arange(70) / 100.0, np.zeros(70), speed)
    figures = evaluate_model(PhysicalModel(), still, np.ones(1), [run]).pooled
    assert figures.r2 == pytest.approx(0.0, abs=1e-6)
    assert figures.max_error_rad_s == pytest.approx(1.0)


def test_missing_samples_count_nowhere(run: Run) -> None:
    missing = np.random.default_rng(3).random(run.samples) < 0.4
    missing[:10] = False
    speed = run.speed_rad_s.copy()
    speed[missing] = np.nan
    figures = evaluate_model(PhysicalModel(), PARAMETERS, SIGMA, [Run("lossy", run.t_s, run.command, speed)]).pooled
    whole = free_run_residuals(PhysicalModel(), PARAMETERS, [run])
    assert figures.samples == np.count_nonzero(~missing)
    assert figures.rmse_rad_s == pytest.approx(np.sqrt(np.mean(whole[~missing] ** 2)), rel=1e-12)


def test_the_free_run_starts_again_after_a_long_gap(run: Run) -> None:
    later = run.t_s + np.where(run.t_s > 15.0, 3600.0, 0.0)
    gapped = Run("gapped", later, run.command, run.speed_rad_s)
    assert evaluate_model(PhysicalModel(), PARAMETERS, SIGMA, [gapped]).pooled.rmse_rad_s < 1.1 * fan_data.NOISE_RAD_S


def test_sigma_is_about_the_twin_so_a_bias_widens_it() -> None:
    assert healthy_sigma_rad_s(np.array([[3.0, 1.0], [3.0, -1.0], [np.nan, 1.0]])).tolist() == [3.0, 1.0]


def test_a_diverging_free_run_is_infinite_not_an_exception(run: Run) -> None:
    runaway = np.array([[0.001, 0.0, -1.0]])
    figures = evaluate_model(PhysicalModel(), runaway, SIGMA, [run]).pooled
    assert figures.rmse_rad_s == np.inf
    assert figures.r2 == -np.inf


def test_a_twin_of_one_fan_serves_many_and_a_twin_of_two_does_not_serve_three() -> None:
    one = train_twin([fan_data.published_run(1, 15.0)], [], "physical", name="one")
    three = fan_data.published_run(2, 15.0, fans=3)
    assert len(evaluate(one, [three]).per_fan) == 3
    two = train_twin([fan_data.published_run(1, 15.0, fans=2)], [], "physical", name="two")
    with pytest.raises(TwinError, match="twin 'two' is of 2 fans, the runs of 3"):
        evaluate(two, [three])
