"""NARX: sized as published, differentiated exactly, and a competitor in its free run."""

from dataclasses import replace

import numpy as np
import pytest

from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.accuracy import evaluation_pieces, free_run_residuals, pooled_rmse_rad_s
from fantwin.twin.fitting.narx_fit import forgets_its_start, free_run_sensitivities
from fantwin.twin.fitting.narx_training import train_narx
from fantwin.twin.models.narx import ORDER, PARAMETER_COUNT, Narx
from fantwin.twin.models.network import Scaling
from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.runs import Array, Run
from tests.support import fan_data

SCALING = Scaling(90.0, 100.0, 50.0, 50.0, 300.0)


def random_narx(size: float = 0.1) -> Narx:
    return Narx(np.random.default_rng(1).normal(scale=size, size=PARAMETER_COUNT), SCALING)


def advanced(model: Narx, state: Array, command: Array) -> tuple[Array, Array]:
    return model.advance(state, command, np.full(len(command), 0.01), np.ones((len(state), len(PARAMETER_NAMES))))


def free_run_rmse_rad_s(model: Narx, run: Run) -> float:
    parameters = np.ones((run.fans, len(PARAMETER_NAMES)))
    return pooled_rmse_rad_s(free_run_residuals(model, parameters, evaluation_pieces([run])))


def trained(run: Run, seed: int = 0, max_iterations: int = 25) -> Narx:
    return train_narx([run], [], SCALING, seed=seed, max_iterations=max_iterations)[0]


def test_the_free_run_is_differentiated_exactly_by_every_weight() -> None:
    model = random_narx(0.3)
    command = fan_data.stairs(np.random.default_rng(4), 120, 1)

    def run(theta: Array) -> Array:
        state = model.state_layout.initial_state(np.array([20.0]), command[0])
        return advanced(replace(model, theta=theta), state, command)[0][:, 0]

    by_theta = free_run_sensitivities(model, run(model.theta), command[:, 0])
    for index in range(0, PARAMETER_COUNT, 7):
        move = np.zeros(PARAMETER_COUNT)
        move[index] = 1e-5
        slope = (run(model.theta + move) - run(model.theta - move)) / 2e-5
        np.testing.assert_allclose(by_theta[index], slope, rtol=1e-5, atol=1e-5)


def test_a_recursion_with_two_steady_states_is_not_trusted() -> None:
    def one_unit(feedback: float) -> Narx:
        # w' = 2 tanh(feedback w + 0.1 u): two steady states without a command where 2 * feedback exceeds one.
        theta = np.zeros((23, 50))
        theta[0, 0], theta[ORDER, 0], theta[-1, 0] = feedback, 0.1, 2.0
        return Narx(np.append(theta.ravel(), 0.0), SCALING)

    assert forgets_its_start(one_unit(0.3), 10.0)
    assert not forgets_its_start(one_unit(1.0), 10.0)


@pytest.mark.slow
def test_trained_it_forgets_its_start_and_comes_near_the_noise_on_commands_it_never_saw() -> None:
    model = trained(fan_data.published_run(1, 25.0))
    assert forgets_its_start(model, 25.0)
    assert free_run_rmse_rad_s(model, fan_data.published_run(11, 40.0)) < 1.05 * fan_data.NOISE_RAD_S


def test_runs_without_speeds_are_refused_in_one_line() -> None:
    run = fan_data.published_run(1, 1.0)
    empty = replace(run, speed_rad_s=np.full_like(run.speed_rad_s, np.nan))
    with pytest.raises(TwinError, match="two measured speeds"):
        trained(empty)
