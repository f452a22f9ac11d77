"""The figures, against residuals that are known, and the command that prints them."""

import json
import re
from pathlib import Path

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
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.models.model import TwinModel
from fantwin.twin.models.narx import PARAMETER_COUNT, Narx
from fantwin.twin.models.network import Scaling
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.runs import Array, Run
from tests.pipeline.cli.conftest import MadeOnce
from tests.support import fan_data
from tests.support.fantwin_command import fantwin
from tests.support.written_recordings import write_run


def parameters_of(**values: float) -> Array:
    return np.array([[values.get(name, 0.0) for name in PARAMETER_NAMES]])


PUBLISHED = dict(zip(("J", "alpha", "C_D"), fan_data.PUBLISHED_PARAMETERS.tolist(), strict=True))
PARAMETERS = parameters_of(**PUBLISHED)
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
    still = parameters_of(J=1.0, alpha=1e-9)
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
    found = one_step_residual(model, parameters, run)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-7)
    assert 0.2 < np.mean(np.isfinite(found)) < 0.9


def test_a_diverging_free_run_is_infinite_not_an_exception(run: Run) -> None:
    runaway = parameters_of(J=0.001, C_D=-1.0)
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


@pytest.fixture(scope="module")
def recorded(made_once: MadeOnce) -> tuple[Path, Path]:
    """A twin and a recording of two fans."""

    def make(folder: Path) -> None:
        recording = write_run(folder / "two.mcap", fan_data.published_run(4, 15.0, fans=2), unit="rpm")
        trained = fantwin("train", recording, "--model", "narx", "--iterations", 1, "-o", folder / "twin.onnx")
        assert trained.exit_code == 0, trained.output

    folder = made_once("evaluated", make)
    return folder / "twin.onnx", folder / "two.mcap"


def test_the_json_of_evaluate_has_other_grids_and_the_residual_analysis(recorded: tuple[Path, Path]) -> None:
    arguments = ("--rate", "50", "--rate", "irregular", "--json")
    result = json.loads(fantwin("evaluate", *recorded, *arguments).stdout)
    assert [(grid["rate"], grid["samples"], len(grid["fans"])) for grid in result["grids"][:1]] == [(50.0, 1500, 2)]
    assert result["grids"][1]["rate"] == "irregular"
    assert result["grids"][0]["rmse"] != result["rmse"]
    assert result["expected_coverage_2_sigma"] == pytest.approx(0.9545, abs=1e-4)
    for fan in result["fans"]:
        left = fan["residual"]
        assert left["samples"] == 1500 - 300
        assert len(left["cross_lags_s"]) == 2 * len(left["lags_s"]) + 1 > 200
        assert left["white"] == (left["ljung_box_p"] >= 0.05)


def test_evaluate_shows_a_row_for_each_fan_and_each_grid_and_warns_as_the_report_does(
    recorded: tuple[Path, Path], tmp_path: Path
) -> None:
    evaluated = fantwin("evaluate", *recorded, "--rate", "12.5", "--rate", "irregular")
    rows = re.findall(r"^ ([\d.]+ Hz|\d+|all|recorded|irregular) ", evaluated.stdout, re.MULTILINE)
    assert rows == ["0", "1", "all", "recorded", "12.5 Hz", "irregular"]
    assert "free run: rmse" in evaluated.stdout.splitlines()[1]
    alone = json.loads(fantwin("evaluate", *recorded, "--json").stdout)
    one_fan = (*recorded, "--fans", "1", "--json")
    of_one = json.loads(fantwin("evaluate", *one_fan).stdout)
    reported = json.loads(fantwin("report", *one_fan, "-o", tmp_path / "page.html").stdout)
    for key in ("warnings", "assessment", "headline"):
        assert of_one[key] == reported[key]
    assert "two.mcap: used in training" in alone["warnings"][0]
    assert evaluated.stderr.splitlines() == alone["warnings"]


@pytest.fixture(scope="module")
def tray(made_once: MadeOnce) -> Path:
    """A folder with a recording of three fans that differ, and a twin of the first and the last."""

    def make(folder: Path) -> None:
        recording = write_run(folder / "three.mcap", fan_data.rough_run(5, 15.0, fans=3))
        write_run(folder / "two.mcap", fan_data.rough_run(5, 15.0, fans=2))
        made = fantwin("train", recording, "--fans", "0,2", "--model", "physical", "-o", folder / "twin.onnx")
        assert made.exit_code == 0, made.output

    return made_once("three-fans", make)


def test_a_card_names_the_fans_it_is_of_and_a_fan_is_judged_by_its_own_parameters(tray: Path, tmp_path: Path) -> None:
    twin, recording = tray / "twin.onnx", tray / "three.mcap"
    assert OnnxTwin(twin).card.training.fans == (0, 2)
    both = json.loads(fantwin("evaluate", twin, recording, "--fans", "0,2", "--rate", "50", "--json").stdout)
    last = json.loads(fantwin("evaluate", twin, recording, "--fans", "2", "--rate", "50", "--json").stdout)
    assert last["fans"] == [both["fans"][1]]
    assert last["grids"][0]["fans"] == [both["grids"][0]["fans"][1]]
    page = tmp_path / "page.html"
    reported = json.loads(fantwin("report", twin, recording, "--fans", "2", "-o", page, "--json").stdout)
    assert [fan["fan"] for fan in reported["fans"]] == [2]
    assert reported["fans"][0]["rmse"] == last["rmse"]
    parameters = OnnxTwin(twin).parameters
    assert f'<data value="{parameters[1, 0]}">' in page.read_text()
    assert f'<data value="{parameters[0, 0]}">' not in page.read_text()
