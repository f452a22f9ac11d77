"""The expected readings of a tacho against its definition, and twins of fans whose tachos count."""

from dataclasses import replace

import numpy as np
import pytest

from fantwin.schemas.tacho import INSTANTANEOUS, Tacho
from fantwin.scoring.expected_reading import AveragedCommand
from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.errors import TwinError
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.fitting.identification import identify
from fantwin.twin.runs import Run
from fantwin.twin.tacho_readings import Measurement, measurement_of
from tests.support.fan_data import PUBLISHED_PARAMETERS, counted_run
from tests.support.made_once import TrainedOnce

SLOW = Tacho(kind="count", window_s=1.0)
TACHOS = [
    SLOW,
    Tacho(kind="count", window_s=0.5, update_s=0.1, delay_s=0.07),
    Tacho(kind="average", window_s=0.4, update_s=1.5, step_rad_s=0.1),
    Tacho(delay_s=0.3),
    Tacho(),
]


def uneven_times(samples: int, signals: int) -> np.ndarray:
    steps = np.random.default_rng(3).uniform(0.02, 0.18, (samples, signals))
    return 5.0 + np.cumsum(steps, axis=0)


def mean_reading(tacho: Tacho, t_s: float, times: np.ndarray, signal: np.ndarray, held: bool) -> float:
    """The mean over many ages and many instants of the window."""
    fine = (np.arange(400) + 0.5) / 400
    at_s = t_s - tacho.delay_s - np.add.outer(tacho.held_s * fine, tacho.window_s * fine)
    if held:
        return float(signal[np.maximum(np.searchsorted(times, at_s, side="right") - 1, 0)].mean())
    return float(np.interp(at_s, times, signal).mean())


@pytest.mark.parametrize("held", [False, True], ids=["speed", "command"])
def test_the_expected_reading_is_the_mean_over_window_and_age(held: bool) -> None:
    times = uneven_times(80, len(TACHOS))
    signals = 200.0 + 50.0 * np.random.default_rng(4).standard_normal(times.shape).cumsum(axis=0)
    measurement = Measurement(times, TACHOS)
    shown = measurement.of_command(signals) if held else measurement.of_speed(signals)
    for column, tacho in enumerate(TACHOS[:4]):
        # Also where the window reaches before the first sample, whose value then counts as constant.
        for k in (0, 3, 15, 40, 78):
            ends = (k, k + 1) if held else (k,)
            at_ends = [mean_reading(tacho, times[i, column], times[:, column], signals[:, column], held) for i in ends]
            assert shown[k, column] == pytest.approx(np.mean(at_ends), abs=0.3 if held else 0.01)


@pytest.mark.parametrize("tacho", TACHOS[:2], ids=str)
def test_the_runtime_averages_commands_as_the_maker_does(tacho: Tacho) -> None:
    period_s = 0.1
    command = np.repeat(np.random.default_rng(7).uniform(0.0, 100.0, 60), 10)[:, np.newaxis]
    measurement = Measurement(period_s * np.arange(len(command), dtype=np.float64)[:, np.newaxis], [tacho])
    of_runtime = AveragedCommand([tacho], period_s).update(command)
    both = np.isfinite(of_runtime) & measurement.comparable
    assert np.count_nonzero(both) > 550
    expected = measurement.of_command(command)[both]
    # The maker holds commands, the runtime takes them as linear between samples, half a sample earlier.
    assert np.std(of_runtime[both] - expected) < 0.02 * np.std(expected)


# Not a multiple of the sample period: ages of readings then take all values, as between clocks that drift.
TACHO = Tacho(kind="count", window_s=0.53)


@pytest.fixture(scope="module")
def runs() -> tuple[Run, Run]:
    return counted_run(1, TACHO, 200.0), counted_run(2, TACHO, 60.0)


@pytest.fixture(scope="module")
def twin(runs: tuple[Run, Run], trained_once: TrainedOnce) -> TrainedTwin:
    return trained_once(runs[:1], runs[1:], "physical", name="counted")


def taken_as_instantaneous(run: Run) -> Run:
    return replace(run, tacho=INSTANTANEOUS)


def test_the_physics_are_those_of_the_fan_and_the_error_is_that_of_the_tacho(
    twin: TrainedTwin, runs: tuple[Run, Run]
) -> None:
    found = twin.identification.parameters[0, :3] / PUBLISHED_PARAMETERS
    np.testing.assert_allclose(found, 1.0, atol=0.15)
    figures = twin.validation.pooled
    assert figures.rmse_rad_s == pytest.approx(figures.floor_rad_s, rel=0.1)
    assert twin.card.tacho == (TACHO,)
    naive = train_twin([taken_as_instantaneous(runs[0])], [taken_as_instantaneous(runs[1])], "physical", name="naive")
    assert naive.identification.parameters[0, 0] > 3.0 * PUBLISHED_PARAMETERS[0]
    assert naive.validation.pooled.rmse_rad_s > 1.5 * figures.rmse_rad_s
    assert naive.card.balance.sigma_command[0] > 3.0 * twin.card.balance.sigma_command[0]


def test_a_twin_is_evaluated_by_the_tacho_of_its_card_and_not_where_readings_show_the_time_before(
    twin: TrainedTwin, runs: tuple[Run, Run]
) -> None:
    held_out = runs[1]
    figures = evaluate(twin, [taken_as_instantaneous(held_out)]).pooled
    assert figures == evaluate(twin, [held_out]).pooled == twin.validation.pooled
    late = held_out.t_s - held_out.t_s[0] >= TACHO.reach_s
    assert figures.samples == np.count_nonzero(np.isfinite(held_out.speed_rad_s[:, 0]) & late)


def uneven_run(tacho: Tacho) -> Run:
    """A first-order lag, 0.8 s upwards and 1.6 s downwards: no physical model has two inertias."""
    command = np.repeat(np.random.default_rng(1).permutation(np.tile(np.linspace(0.25, 1.0, 7), 6)), 80)
    speed = np.empty_like(command)
    speed[0] = 200.0 * command[0]
    for k in range(1, len(command)):
        wanted = 200.0 * command[k - 1]
        speed[k] = wanted + (speed[k - 1] - wanted) * np.exp(-0.1 / (0.8 if wanted > speed[k - 1] else 1.6))
    run = Run("made", np.arange(len(command)) / 10.0, command[:, np.newaxis], speed[:, np.newaxis], (tacho,))
    return replace(run, speed_rad_s=measurement_of(run).of_speed(run.speed_rad_s))


@pytest.mark.parametrize("wrong_rad_s", [0.0, 1000.0])
def test_a_fan_that_slows_down_more_slowly_than_it_speeds_up_keeps_its_steady_speeds(wrong_rad_s: float) -> None:
    run = uneven_run(TACHO)
    wrong = np.zeros_like(run.speed_rad_s)
    wrong[1000] = wrong_rad_s
    run = replace(run, speed_rad_s=run.speed_rad_s + wrong)
    _, alpha, drag, _ = identify([run]).parameters[0]
    steady = np.linspace(0.25, 1.0, 4)
    found = 2.0 * steady / (alpha + np.sqrt(alpha**2 + 4.0 * drag * steady))
    np.testing.assert_allclose(found, 200.0 * steady, atol=1.0)  # 3.7 if all readings counted alike


def test_a_narx_predicts_readings_as_they_are(runs: tuple[Run, Run]) -> None:
    twin = train_twin([runs[0].rows(0, 500)], [], "narx", name="narx", max_iterations=1)
    assert twin.card.tacho == INSTANTANEOUS, "no tacho averages them once more"


def test_runs_that_are_measured_differently_and_the_published_trainer_are_refused(runs: tuple[Run, Run]) -> None:
    one, other = runs
    with pytest.raises(TwinError, match="measured alike"):
        train_twin([one], [taken_as_instantaneous(other)], "physical", name="mixed")
    with pytest.raises(TwinError, match="trainer 'adam' takes readings for speeds"):
        train_twin([one], [], "hybrid", name="adam", trainer="adam", max_iterations=1)
