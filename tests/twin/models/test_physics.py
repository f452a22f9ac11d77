"""The physical equation and its derivatives."""

import numpy as np

from fantwin.twin.models import physics

PARAMETERS = np.array([[0.15, 0.012, 0.0025, 0.0], [0.003, 0.03, 1e-5, 0.01]])


def test_at_steady_state_the_command_balances_friction_and_drag() -> None:
    speed = np.array([200.0, 700.0])
    command = PARAMETERS[:, 1] * speed + PARAMETERS[:, 2] * speed**2
    np.testing.assert_allclose(physics.acceleration(speed, command, PARAMETERS), 0.0, atol=1e-9)


def test_drag_opposes_a_fan_driven_backwards() -> None:
    speed, still = np.array([-50.0, -50.0]), np.zeros(2)
    np.testing.assert_array_equal(
        physics.acceleration(speed, still, PARAMETERS), -physics.acceleration(-speed, still, PARAMETERS)
    )
    assert np.all(physics.acceleration(speed, still, PARAMETERS) > 0.0)


def test_derivatives_agree_with_finite_differences() -> None:
    speed, command = np.array([120.0, -30.0]), np.array([40.0, 5.0])
    difference = 1e-4
    by_speed = (
        physics.acceleration(speed + difference, command, PARAMETERS)
        - physics.acceleration(speed - difference, command, PARAMETERS)
    ) / (2 * difference)
    np.testing.assert_allclose(physics.acceleration_by_speed(speed, PARAMETERS), by_speed, rtol=1e-6)
    exact = np.empty((2, 3))
    physics.acceleration_by_parameters(speed, command, PARAMETERS, exact)
    for index in range(3):
        move = np.zeros_like(PARAMETERS)
        move[:, index] = 1e-6 * PARAMETERS[:, index]
        change = physics.acceleration(speed, command, PARAMETERS + move) - physics.acceleration(
            speed, command, PARAMETERS - move
        )
        np.testing.assert_allclose(exact[:, index], change / (2 * move[:, index]), rtol=1e-5)
