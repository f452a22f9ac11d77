"""The four models: their derivatives, their equality, their bounds."""

import numpy as np
import pytest

from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.physical import fitted_unknowns, physical_parameters
from tests.support import fan_data
from tests.support.random_models import random_network

PARAMETERS = np.tile([*fan_data.PUBLISHED_PARAMETERS, 0.02], (2, 1))


@pytest.mark.parametrize("inputs", [("speed", "command"), ("speed",)])
def test_the_network_is_differentiated_exactly(inputs: tuple[str, ...]) -> None:
    network = random_network(10, inputs)
    rhs = Hybrid(network).equation(PARAMETERS)
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
    np.testing.assert_allclose(physical_parameters(fitted_unknowns(PARAMETERS, top), top), PARAMETERS, rtol=1e-12)
    unstable = np.array([[0.1, 0.5, -0.01, 0.0], [0.1, -0.2, 0.004, 0.01]])
    stable = physical_parameters(fitted_unknowns(unstable, top), top)
    assert np.all(stable[:, 1] > 0.0)
    assert np.all(stable[:, 1] + 2.0 * stable[:, 2] * top > 0.0)
