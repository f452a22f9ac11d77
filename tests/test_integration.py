"""The integrator's order, and the exactness of its derivatives."""

import numpy as np

from twin.integration import free_run, free_run_sensitivities
from twin.physical import PhysicalRightHandSide

PARAMETERS = np.array([[0.15, 0.012, 0.0025]])


def right_hand_side(parameters: np.ndarray) -> PhysicalRightHandSide:
    return PhysicalRightHandSide(parameters, np.tile(np.eye(3), (len(parameters), 1, 1)))


def speed_after(duration_s: float, steps: int) -> float:
    command, step_s = np.full((steps, 1), 60.0), np.full(steps, duration_s / steps)
    _, final = free_run(right_hand_side(PARAMETERS).acceleration, np.array([10.0]), command, step_s)
    return float(final[0])


def test_halving_the_step_divides_the_error_by_sixteen() -> None:
    exact = speed_after(0.8, 8192)
    errors = [abs(speed_after(0.8, steps) - exact) for steps in (32, 64, 128)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 4.0, atol=0.25)


def test_each_speed_is_the_one_before_its_own_command_acts() -> None:
    command = np.array([[0.0], [100.0], [100.0]])
    speed, final = free_run(right_hand_side(PARAMETERS).acceleration, np.zeros(1), command, np.full(3, 0.01))
    assert speed[0, 0] == 0.0
    assert speed[1, 0] == 0.0
    assert 0.0 < speed[2, 0] < final[0]


def test_a_step_of_zero_leaves_the_speed_where_it_is() -> None:
    speed, final = free_run(
        right_hand_side(PARAMETERS).acceleration, np.array([7.0]), np.full((3, 1), 50.0), np.zeros(3)
    )
    np.testing.assert_array_equal(speed[:, 0], 7.0)
    assert final[0] == 7.0


def test_sensitivities_agree_with_finite_differences_over_irregular_steps() -> None:
    rng = np.random.default_rng(5)
    command, step_s = rng.uniform(0.0, 90.0, (60, 1)), rng.uniform(0.002, 0.03, (60, 1))

    def run(values: np.ndarray) -> np.ndarray:
        return free_run(right_hand_side(values[None, :3]).acceleration, values[3:], command, step_s)[0]

    point = np.append(PARAMETERS[0], 30.0)
    exact = free_run_sensitivities(right_hand_side(PARAMETERS), run(point), command, step_s)
    for index, size in enumerate(point):
        move = np.zeros(4)
        move[index] = 1e-5 * size
        numeric = (run(point + move) - run(point - move)) / (2e-5 * size)
        np.testing.assert_allclose(exact[:, :, index], numeric, rtol=1e-5, atol=1e-6 * np.abs(numeric).max())
