"""twin.fitting.balance_fit: coefficients are those of the fan, the better candidate is chosen, sigma is that of
noise."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.training import published_fan
from fantwin.pipeline.recordings.training_runs import read_runs
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.twin_card import BalanceCard
from fantwin.simulation.plant import FanParameters, advance, at_rest
from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.resampling import resampled
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.fitting.balance_fit import FILTER_RATE_PER_S, fit_balance
from fantwin.twin.fitting.identification import Identification, identify
from fantwin.twin.runs import Array, Run
from tests.support.fan_data import NOISE_RAD_S, torque_balance
from tests.support.fantwin_command import fantwin

PLANT = FanParameters(stribeck_rad_s=1.0)
DUTY_PER_V = (PLANT.duty_full - PLANT.duty_dead) / PLANT.supply_v
TRUTH = (
    np.array([PLANT.J, PLANT.alpha, PLANT.C_D, PLANT.coulomb_v + PLANT.duty_dead / DUTY_PER_V], dtype=np.float64)
    * DUTY_PER_V
)
"""The balance coefficients of PLANT, in duty; friction and the dead zone of its bridge are one term."""


@pytest.fixture(scope="module")
def published() -> tuple[Run, Identification]:
    run = published_fan.published_training(1).run
    return run, identify([run])


@pytest.fixture(scope="module")
def without_noise() -> Run:
    """24 times the fan PLANT, each on its own command, at 100 Hz."""
    fans = 24
    duty = published_fan.random_stairs(3, 40.0, fans, 0.05, 1.0)
    state, speeds = at_rest(fans), []
    for held in duty:
        speeds.append(state.speed_rad_s)
        state = advance(state, held, 0.01, PLANT)
    return Run("plants", np.arange(len(duty)) / 100.0, duty, np.array(speeds))


@pytest.fixture(scope="module")
def plants(without_noise) -> tuple[Run, Identification]:
    """Each with its own noise; identified once."""
    fans, noise_rad_s = without_noise.fans, 4.0
    noise = np.random.default_rng(4).normal(0.0, noise_rad_s, without_noise.speed_rad_s.shape)
    run = replace(without_noise, speed_rad_s=without_noise.speed_rad_s + noise)
    one = identify([run.fan(0)])
    many = {
        "parameters": np.repeat(one.parameters, fans, axis=0),
        "covariance": np.repeat(one.covariance, fans, axis=0),
    }
    return run, replace(one, **many, top_speed_rad_s=np.repeat(one.top_speed_rad_s, fans))


def coefficients(fit: BalanceCard) -> Array:
    """(fans, 4)"""
    return np.column_stack((fit.inertia, fit.viscous, fit.drag, fit.friction))


def test_exact_physics_are_kept_and_sigma_follows_from_the_noise_of_the_tacho(published) -> None:
    run, identification = published
    fit = fit_balance([run], [], identification)
    assert fit.source == ("physics",)
    np.testing.assert_array_equal(coefficients(fit)[:, :3], identification.parameters[:, :3])
    np.testing.assert_allclose(np.diagonal(fit.covariance[0])[:3], identification.standard_errors[0, :3] ** 2)
    assert abs(coefficients(fit)[0, 3]) < 4.0 * np.sqrt(fit.covariance[0][3][3])
    assert fit.sigma_command[0] == pytest.approx(coefficients(fit)[0, 0] * FILTER_RATE_PER_S * NOISE_RAD_S, rel=0.08)
    assert 0.005 <= fit.autocorrelation_time_s[0] < 0.1
    assert fit.lowest_speed_rad_s[0] == pytest.approx(0.05 * np.quantile(run.speed_rad_s, 0.99))


def test_with_friction_least_squares_find_it_and_the_other_coefficients(plants) -> None:
    run, identification = plants
    fit = fit_balance([run], [], identification)
    assert fit.source.count("least-squares") > 0.9 * run.fans
    found = coefficients(fit).mean(axis=0)
    np.testing.assert_allclose(found[:3], TRUTH[:3], rtol=0.03)
    assert found[3] == pytest.approx(TRUTH[3], abs=0.005), "half a per cent of the full command"


def counted(run: Run, tacho: Tacho) -> Run:
    """What a tacho that counts would have read of the speeds of a run at 100 Hz."""
    held = round(100.0 * tacho.window_s)
    turned = np.cumsum(run.speed_rad_s, axis=0) / 100.0 / tacho.resolution_rad_s / tacho.window_s
    pulses = np.floor(turned[held - 1 :: held])
    readings = np.diff(pulses, axis=0, prepend=0.0) * tacho.resolution_rad_s
    shown = np.repeat(readings, held, axis=0)[: run.samples - held]
    return replace(run.rows(held, held + len(shown)), speed_rad_s=shown, tacho=(tacho,))


def test_with_a_tacho_that_counts_least_squares_have_to_explain_more_than_its_errors_could(
    without_noise, plants
) -> None:
    run, (_, identification) = without_noise, plants
    coarse, fine = Tacho(kind="count", window_s=0.1), Tacho(kind="count", pulses=1000, window_s=0.01)
    assert set(fit_balance([counted(run, coarse)], [], identification).source) == {"physics"}
    assert fit_balance([counted(run, fine)], [], identification).source.count("least-squares") > 0.7 * run.fans
    wrong = replace(identification, parameters=identification.parameters * (4.0, 1.0, 1.0, 1.0))
    assert set(fit_balance([counted(run, coarse)], [], wrong).source) == {"least-squares"}


def test_held_out_runs_judge_and_teach_nothing(published) -> None:
    run, identification = published
    other = published_fan.published_test(5).run
    alone, judged = fit_balance([run], [], identification), fit_balance([run], [other], identification)
    np.testing.assert_array_equal(coefficients(judged), coefficients(alone))
    assert judged.sigma_command[0] != alone.sigma_command[0]


@pytest.mark.parametrize("how", ["braked to a stop", "not read at times"])
def test_nothing_is_learned_while_a_fan_stands_and_a_few_missing_speeds_are_bridged(published, how: str) -> None:
    run, identification = published
    speed = run.speed_rad_s.copy()
    if how == "braked to a stop":
        speed[2000:2500] = 0.0
    else:
        speed[np.random.default_rng(1).random(run.samples) < 0.05] = np.nan
    disturbed, free = (fit_balance([r], [], identification) for r in (replace(run, speed_rad_s=speed), run))
    assert disturbed.source == free.source
    np.testing.assert_allclose(disturbed.sigma_command, free.sigma_command, rtol=0.05)


def test_runs_too_short_are_refused_in_one_line(published) -> None:
    run, identification = published
    with pytest.raises(TwinError, match=r"^fan 0: no run in which it turns for more than 1 s on end.*$"):
        fit_balance([run.between(10.0, 10.9)], [], identification)


@pytest.mark.data
def test_on_rosa_the_balance_is_small_in_healthy_runs_and_large_in_faults(measured_data, tmp_path) -> None:
    """A rotor with dry friction under a speed loop: the coefficients from the physics are absurd."""

    def imported(name: str) -> Path:
        recording = tmp_path / f"{name}.mcap"
        columns = ("--time", "Time:ms", "--command", "Shaft Control Effort", "--speed", "Actual Speed:rpm")
        assert fantwin("import", measured_data / "rosa" / f"{name}.csv", *columns, "-o", recording).exit_code == 0
        return recording

    learned = [imported(f"healthy_{k}") for k in (44, 98, 103, 110, 120)]
    result = fantwin("train", *learned, "--model", "physical", "--command-unit", "%", "-o", tmp_path / "t.onnx")
    assert "torque balance: healthy sigma 0.2" in result.stdout
    of_card = OnnxTwin(tmp_path / "t.onnx").card.balance
    assert of_card.source == ("least-squares",)
    assert 0.1 < of_card.sigma_command[0] < 0.3
    assert 4.0 < of_card.friction[0] < 8.0

    def seconds(name: str) -> tuple[Array, Array]:
        """Balance from the second second on: its samples, and their mean in each second."""
        (recorded,) = read_runs(imported(name)).runs
        run = Run(name, recorded.t_s, recorded.command, recorded.speed_rad_s)
        grid = resampled(run, 100.0)
        balance = torque_balance(grid.command, grid.speed_rad_s, 0.01, coefficients(of_card), np.array(of_card.lag_s))[
            100:, 0
        ]
        return balance, balance[: len(balance) // 100 * 100].reshape(-1, 100).mean(axis=1)

    for name in ("healthy_105", "healthy_118"):
        assert 0.1 < np.nanstd(seconds(name)[0]) < 0.3, name
    for name in ("lateral_203", "vibration_305"):
        _, by_second = seconds(name)
        assert by_second.max() - by_second[[0, -1]].min() > 4.0, name
