"""The figures, against residuals that are known, and the command that prints them."""

import json
from pathlib import Path

import fan_data
import numpy as np
import pytest

from tests.fantwin_command import fantwin, said_instead
from tests.test_train_commands import record
from twin.build import evaluate, train_twin
from twin.errors import TwinError
from twin.evaluation import evaluate_model, free_run_residuals, healthy_sigma_rad_s, one_step_residuals
from twin.models import TwinModel
from twin.narx import PARAMETER_COUNT, Narx
from twin.network import Scaling
from twin.physical import PhysicalModel
from twin.physics import PARAMETER_NAMES
from twin.runs import Array, Run


def parameters_of(**values: float) -> Array:
    return np.array([[values.get(name, 0.0) for name in PARAMETER_NAMES]])


PUBLISHED = dict(zip(("J", "alpha", "C_D"), fan_data.PUBLISHED_PARAMETERS.tolist(), strict=True))
PARAMETERS = parameters_of(**PUBLISHED)
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
    still = parameters_of(J=1.0, alpha=1e-9)
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


@pytest.mark.parametrize("every", [1, 5, 10])
def test_a_fan_that_gathers_speed_from_the_first_sample_on_is_not_started_too_fast(every: int) -> None:
    # From rest towards 126 rad/s; every tenth sample: the mean of the first five is 40 rad/s, the first one 0.
    fine = Run("start", np.arange(3000) / 100.0, np.full(3000, 60.0), np.zeros(3000))
    speed, _ = PhysicalModel().advance(np.array([[0.0, 60.0]]), fine.command, fine.step_s, PARAMETERS)
    run = Run("start", fine.t_s, fine.command, speed)
    thinned = Run("thinned", run.t_s[::every], run.command[::every], run.speed_rad_s[::every])
    assert evaluate_model(PhysicalModel(), PARAMETERS, SIGMA, [thinned]).pooled.max_error_rad_s < 0.1
    sparse = np.where(np.arange(3000)[:, np.newaxis] % every == 0, run.speed_rad_s, np.nan)
    missing = Run("missing", run.t_s, run.command, sparse)
    assert evaluate_model(PhysicalModel(), PARAMETERS, SIGMA, [missing]).pooled.max_error_rad_s < 0.1


def test_a_fan_first_measured_when_its_start_is_long_forgotten_is_still_followed(run: Run) -> None:
    speed = run.speed_rad_s.copy()
    speed[:2000] = np.nan
    late = Run("late", run.t_s, run.command, speed)
    figures = evaluate_model(PhysicalModel(), PARAMETERS, SIGMA, [late]).pooled
    assert figures.rmse_rad_s == pytest.approx(fan_data.NOISE_RAD_S, rel=0.06)
    assert figures.samples == 1000


def lossy_and_irregular(samples: int = 400) -> Run:
    rng = np.random.default_rng(5)
    t_s = np.cumsum(rng.choice([0.008, 0.01, 0.013], samples))
    speed = rng.normal(80.0, 5.0, (samples, 2))
    speed[rng.random((samples, 2)) < 0.1] = np.nan
    return Run("lossy and irregular", t_s, fan_data.random_stairs(rng, samples, 2), speed)


def random_narx() -> Narx:
    rng = np.random.default_rng(6)
    return Narx(rng.normal(0.0, 0.2, PARAMETER_COUNT), Scaling(80.0, 20.0, 50.0, 30.0, 100.0))


@pytest.mark.parametrize("lag_s", [0.0, 0.05])
@pytest.mark.parametrize("model", [PhysicalModel(), random_narx()], ids=["physical", "narx"])
def test_the_one_step_error_takes_speeds_from_the_fan_and_past_commands_from_the_run(
    model: TwinModel, lag_s: float
) -> None:
    run = lossy_and_irregular()
    parameters = np.tile(parameters_of(**PUBLISHED, lag_s=lag_s), (2, 1))
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
    found = one_step_residuals(model, parameters, [run])
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-7)
    assert 0.2 < np.mean(np.isfinite(found)) < 0.9


def test_the_one_step_error_of_the_true_model_is_the_noise_of_two_samples(run: Run) -> None:
    figures = evaluate_model(PhysicalModel(), PARAMETERS, SIGMA, [run]).pooled
    # One noise in the speed it starts from, hardly damped in 10 ms, and one in the speed it is compared with.
    assert figures.one_step_rmse_rad_s == pytest.approx(np.sqrt(2.0) * fan_data.NOISE_RAD_S, rel=0.05)


def test_sigma_is_about_the_twin_so_a_bias_widens_it() -> None:
    assert healthy_sigma_rad_s(np.array([[3.0, 1.0], [3.0, -1.0], [np.nan, 1.0]])).tolist() == [3.0, 1.0]


def test_a_diverging_free_run_is_infinite_not_an_exception(run: Run) -> None:
    runaway = parameters_of(J=0.001, C_D=-1.0)
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


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A twin and a recording of two fans."""
    folder = tmp_path_factory.mktemp("evaluate")
    recording = record(folder / "two.mcap", fan_data.published_run(4, 15.0, fans=2), unit="rpm")
    trained = fantwin("train", recording, "--model", "narx", "--iterations", 1, "-o", folder / "twin.onnx")
    assert trained.exit_code == 0, trained.output
    return folder / "twin.onnx", recording


def test_evaluate_tells_machines_of_other_grids_and_of_what_is_left(recorded: tuple[Path, Path]) -> None:
    arguments = ("--rate", "50", "--rate", "irregular", "--json")
    told = json.loads(fantwin("evaluate", *recorded, *arguments).stdout)
    assert [(grid["rate"], grid["samples"], len(grid["fans"])) for grid in told["grids"][:1]] == [(50.0, 1500, 2)]
    assert told["grids"][1]["rate"] == "irregular"
    assert told["grids"][0]["rmse"] != told["rmse"]
    assert told["expected_coverage_2_sigma"] == pytest.approx(0.9545, abs=1e-4)
    for fan in told["fans"]:
        left = fan["residual"]
        assert left["samples"] == 1500 - 300
        assert len(left["lags_s"]) == len(left["autocorrelation"]) > 100
        assert len(left["cross_lags_s"]) == len(left["cross_correlation"]) == 2 * len(left["lags_s"]) + 1
        assert left["white"] == (left["ljung_box_p"] >= 0.05)
        peak = left["cross_over_bound"] * left["cross_bound_95"]
        at = np.argmin(np.abs(np.array(left["cross_lags_s"]) - left["cross_peak_lag_s"]))
        assert left["cross_correlation"][at] == pytest.approx(peak)
        assert left["independent_samples"] <= left["samples"]


def test_evaluate_shows_a_row_for_each_fan_and_each_grid(recorded: tuple[Path, Path]) -> None:
    shown = fantwin("evaluate", *recorded, "--rate", "12.5", "--rate", "irregular").stdout
    rows = [line.split("│")[1].strip() for line in shown.splitlines() if line.startswith("│")]
    assert rows == ["0", "1", "all", "own", "12.5 Hz", "irregular"]
    assert "free run: rmse" in shown.splitlines()[0]
    assert "Hz" not in fantwin("evaluate", *recorded).stdout


@pytest.mark.parametrize("rate", ["0", "-50", "fast", "nan", "inf"])
def test_a_rate_that_is_none_is_told_in_one_line(recorded: tuple[Path, Path], rate: str) -> None:
    assert f"--rate {rate}: give a rate in Hz" in said_instead("evaluate", *recorded, f"--rate={rate}")


def test_a_rate_too_low_for_the_recording_is_told_in_one_line(recorded: tuple[Path, Path]) -> None:
    assert "no run is long enough to be judged at 0.01 Hz" in said_instead("evaluate", *recorded, "--rate", "0.01")
