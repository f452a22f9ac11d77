"""The figures of a twin, against residuals that are known."""

import numpy as np
import pytest

from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.accuracy import (
    Figures,
    free_run_residuals,
    one_step_residual,
    sums_of_model,
)
from fantwin.twin.models.model import TwinModel
from fantwin.twin.models.narx import PARAMETER_COUNT, Narx
from fantwin.twin.models.network import Scaling
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.runs import Array, Run
from tests.support import fan_data

PARAMETERS = fan_data.published_parameters()
SIGMA = np.array([fan_data.NOISE_RAD_S])


@pytest.fixture(scope="module")
def run() -> Run:
    return fan_data.published_run(21, 30.0)


def figures_on(run: Run, parameters: Array = PARAMETERS, sigma_rad_s: Array = SIGMA) -> Figures:
    """Those of the physical model."""
    return sums_of_model(PhysicalModel(), parameters, sigma_rad_s, [run]).evaluation().pooled


def test_the_true_model_leaves_the_noise_and_two_sigma_cover_95_percent(run: Run) -> None:
    figures = figures_on(run)
    assert figures.rmse_rad_s == pytest.approx(fan_data.NOISE_RAD_S, rel=0.05)
    assert figures.coverage_2_sigma == pytest.approx(0.954, abs=0.02)
    assert figures.r2 > 0.99
    assert figures.samples == run.samples


def test_r2_is_zero_for_a_model_as_good_as_the_mean() -> None:
    still = fan_data.parameters_of(J=1.0, alpha=1e-9)
    speed = np.tile([5.0, 5.0, 5.0, 5.0, 5.0, 4.0, 6.0], 10)
    run = Run("flat", np.arange(70) / 100.0, np.zeros(70), speed)
    figures = figures_on(run, still, np.ones(1))
    assert figures.r2 == pytest.approx(0.0, abs=1e-6)
    assert figures.max_error_rad_s == pytest.approx(1.0)


def test_missing_samples_count_nowhere(run: Run) -> None:
    missing = np.random.default_rng(3).random(run.samples) < 0.4
    missing[:10] = False
    speed = run.speed_rad_s.copy()
    speed[missing] = np.nan
    figures = figures_on(Run("lossy", run.t_s, run.command, speed))
    whole = free_run_residuals(PhysicalModel(), PARAMETERS, [run])
    assert figures.samples == np.count_nonzero(~missing)
    assert figures.rmse_rad_s == pytest.approx(np.sqrt(np.mean(whole[~missing] ** 2)), rel=1e-12)


def test_the_free_run_starts_again_after_a_long_gap(run: Run) -> None:
    later = run.t_s + np.where(run.t_s > 15.0, 3600.0, 0.0)
    gapped = Run("gapped", later, run.command, run.speed_rad_s)
    assert figures_on(gapped).rmse_rad_s < 1.1 * fan_data.NOISE_RAD_S


@pytest.mark.parametrize("every", [1, 10])
def test_a_fan_that_gathers_speed_from_the_first_sample_on_is_not_started_too_fast(every: int) -> None:
    # From rest towards 126 rad/s; every tenth sample: the mean of the first five is 40 rad/s, the first one 0.
    fine = Run("start", np.arange(3000) / 100.0, np.full(3000, 60.0), np.zeros(3000))
    speed, _ = PhysicalModel().advance(np.array([[0.0, 60.0]]), fine.command, fine.step_s, PARAMETERS)
    run = Run("start", fine.t_s, fine.command, speed)
    thinned = Run("thinned", run.t_s[::every], run.command[::every], run.speed_rad_s[::every])
    assert figures_on(thinned).max_error_rad_s < 0.1
    sparse = np.where(np.arange(3000)[:, np.newaxis] % every == 0, run.speed_rad_s, np.nan)
    missing = Run("missing", run.t_s, run.command, sparse)
    assert figures_on(missing).max_error_rad_s < 0.1


def lossy_and_irregular(samples: int = 400) -> Run:
    rng = np.random.default_rng(5)
    t_s = np.cumsum(rng.choice([0.008, 0.01, 0.013], samples))
    speed = rng.normal(80.0, 5.0, (samples, 2))
    speed[rng.random((samples, 2)) < 0.1] = np.nan
    return Run("lossy and irregular", t_s, fan_data.stairs(rng, samples, 2), speed)


def random_narx() -> Narx:
    rng = np.random.default_rng(6)
    return Narx(rng.normal(0.0, 0.2, PARAMETER_COUNT), Scaling(80.0, 20.0, 50.0, 30.0, 100.0))


@pytest.mark.parametrize(("model", "lag_s"), [(PhysicalModel(), 0.0), (random_narx(), 0.05)], ids=["physical", "narx"])
def test_the_one_step_error_takes_speeds_from_the_fan_and_past_commands_from_the_run(
    model: TwinModel, lag_s: float
) -> None:
    run = lossy_and_irregular()
    parameters = fan_data.published_parameters(2, lag_s=lag_s)
    expected = np.full_like(run.speed_rad_s, np.nan)
    speeds = model.state_layout.speed
    state = model.state_layout.initial_state(np.zeros(2), run.command[0])
    for k in range(run.samples - 1):
        if k >= speeds - 1:
            state[:, :speeds] = run.speed_rad_s[k - speeds + 1 : k + 1][::-1].T
        _, state = model.advance(state, run.command[k : k + 1], run.step_s[k : k + 1], parameters)
        if k >= speeds - 1:
            expected[k + 1] = run.speed_rad_s[k + 1] - state[:, 0]
        state[:, :speeds] = 0.0
    found = one_step_residual(model, parameters, run)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-7)
    assert 0.2 < np.mean(np.isfinite(found)) < 0.9


def test_a_diverging_free_run_is_infinite_not_an_exception(run: Run) -> None:
    runaway = fan_data.parameters_of(J=0.001, C_D=-1.0)
    figures = figures_on(run, runaway)
    assert figures.rmse_rad_s == np.inf
    assert figures.r2 == -np.inf


def test_a_twin_of_one_fan_serves_many_and_a_twin_of_two_does_not_serve_three() -> None:
    one = train_twin([fan_data.published_run(1, 15.0)], [], "physical", name="one")
    three = fan_data.published_run(2, 15.0, fans=3)
    assert len(evaluate(one, [three]).per_fan) == 3
    two = train_twin([fan_data.published_run(1, 15.0, fans=2)], [], "physical", name="two")
    with pytest.raises(TwinError, match="twin 'two' has fans 0, 1, the runs have 0, 1, 2"):
        evaluate(two, [three])
