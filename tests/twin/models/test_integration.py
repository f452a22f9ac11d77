"""The integrator's order, its equality with steps, and the exactness of derivatives, also of the models."""

import numpy as np
import pytest

from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.integration import free_run, free_run_sensitivities, step_through
from fantwin.twin.models.lag import effective_command, effective_command_by_lag
from fantwin.twin.models.physical import fitted_unknowns, physical_parameters
from fantwin.twin.models.right_hand_side import FanEquation
from tests.support import fan_data
from tests.support.random_models import random_network

PARAMETERS = np.array([[0.15, 0.012, 0.0025, 0.0]])


def right_hand_side(parameters: np.ndarray) -> FanEquation:
    return FanEquation(parameters, None)


def speed_after(duration_s: float, steps: int) -> float:
    command, step_s = np.full((steps, 1), 60.0), np.full(steps, duration_s / steps)
    _, final = free_run(right_hand_side(PARAMETERS), np.array([10.0]), command, step_s)
    return float(final[0])


def test_halving_the_step_divides_the_error_by_sixteen() -> None:
    exact = speed_after(0.8, 8192)
    errors = [abs(speed_after(0.8, steps) - exact) for steps in (32, 64, 128)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 4.0, atol=0.25)


@pytest.mark.parametrize("guess", ["none", "far"])
def test_a_free_run_solved_at_once_is_the_one_stepped_through(guess: str) -> None:
    rng = np.random.default_rng(7)
    parameters = np.repeat(PARAMETERS, 3, axis=0)
    command = rng.uniform(0.0, 90.0, (40, 3)).repeat(25, axis=0)
    step_s = rng.uniform(0.002, 0.03, command.shape)
    equation, start = right_hand_side(parameters), np.array([0.0, 40.0, 150.0])
    stepped, end = step_through(equation.acceleration, start, command, step_s)
    guesses = {"none": None, "far": rng.uniform(-300.0, 300.0, command.shape)}
    speed, final = free_run(equation, start, command, step_s, guesses[guess])
    np.testing.assert_allclose(speed, stepped, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(final, end, rtol=1e-12)


def test_a_model_that_runs_away_gives_infinities_like_its_steps() -> None:
    runaway = right_hand_side(np.array([[0.15, -1.0, -0.01, 0.0]]))
    command, step_s = np.full((500, 1), 50.0), np.full(500, 0.01)
    with np.errstate(over="ignore", invalid="ignore"):
        stepped, _ = step_through(runaway.acceleration, np.array([10.0]), command, step_s)
    speed, final = free_run(runaway, np.array([10.0]), command, step_s)
    assert not np.isfinite(final[0])
    finite = np.abs(stepped) < 1e6
    assert 10 < finite.sum() < 490
    np.testing.assert_allclose(speed[finite], stepped[finite], rtol=1e-9)


def test_sensitivities_agree_with_finite_differences_over_irregular_steps() -> None:
    rng = np.random.default_rng(5)
    command, step_s = rng.uniform(0.0, 90.0, (60, 1)), rng.uniform(0.002, 0.03, (60, 1))
    before = np.array([20.0])

    def run(values: np.ndarray) -> np.ndarray:
        acting, _ = effective_command(command, step_s, values[3:4], before)
        return free_run(right_hand_side(values[None, :4]), values[4:], acting, step_s)[0]

    point = np.array([*PARAMETERS[0, :3], 0.015, 30.0])
    acting, _ = effective_command(command, step_s, point[3:4], before)
    by_lag = effective_command_by_lag(command, step_s, point[3:4], before)
    exact = free_run_sensitivities(
        right_hand_side(point[None, :4]), run(point), acting, step_s, by_lag[..., np.newaxis]
    )
    for index, size in enumerate(point):
        move = np.zeros(len(point))
        move[index] = 1e-5 * size
        numeric = (run(point + move) - run(point - move)) / (2e-5 * size)
        np.testing.assert_allclose(exact[:, :, index], numeric, rtol=1e-5, atol=1e-6 * np.abs(numeric).max())


PUBLISHED = np.tile([*fan_data.PUBLISHED_PARAMETERS, 0.02], (2, 1))


@pytest.mark.parametrize("inputs", [("speed", "command"), ("speed",)])
def test_the_network_is_differentiated_exactly(inputs: tuple[str, ...]) -> None:
    network = random_network(10, inputs)
    rhs = Hybrid(network).equation(PUBLISHED)
    speed, command = np.array([30.0, 150.0]), np.array([10.0, 80.0])
    value, by_speed, by_command, by_theta = rhs.linearise(speed, command)
    np.testing.assert_allclose(value, rhs.acceleration(speed, command), rtol=1e-13)
    for whole, cheap in zip((value, by_speed), rhs.slope(speed, command), strict=True):
        np.testing.assert_allclose(cheap, whole, rtol=1e-12)
    along = (rhs.acceleration(speed, command + 1e-4) - rhs.acceleration(speed, command - 1e-4)) / 2e-4
    np.testing.assert_allclose(by_command, along, rtol=1e-6)
    slope = (rhs.acceleration(speed + 1e-4, command) - rhs.acceleration(speed - 1e-4, command)) / 2e-4
    np.testing.assert_allclose(by_speed, slope, rtol=1e-6)
    for index in range(network.parameter_count):
        move = np.zeros(network.parameter_count)
        move[index] = 1e-5
        up, down = (network.with_theta(network.theta + sign * move).acceleration(speed, command) for sign in (1, -1))
        np.testing.assert_allclose(by_theta[:, index], (up - down) / 2e-5, rtol=1e-6, atol=1e-6)


def test_the_fitted_unknowns_are_inverted_and_make_any_parameters_stable() -> None:
    top = np.array([180.0, 180.0])
    np.testing.assert_allclose(physical_parameters(fitted_unknowns(PUBLISHED, top), top), PUBLISHED, rtol=1e-12)
    unstable = np.array([[0.1, 0.5, -0.01, 0.0], [0.1, -0.2, 0.004, 0.01]])
    stable = physical_parameters(fitted_unknowns(unstable, top), top)
    assert np.all(stable[:, 1] > 0.0)
    assert np.all(stable[:, 1] + 2.0 * stable[:, 2] * top > 0.0)
