"""The mean of several trainings is a model of the same kind, with the mean of their accelerations."""

import numpy as np
import pytest

from fantwin.twin.fitting.mean_of_networks import mean_model
from fantwin.twin.models.fan_ode import NetworkOde
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.network import Scaling, TanhNetwork
from fantwin.twin.models.neural_ode import NeuralOde
from fantwin.twin.models.physics import LAG
from fantwin.twin.runs import Array

SCALING = Scaling(60.0, 70.0, 0.4, 0.5, 200.0)
FANS = 3
BOTH = ("speed", "command")
Trained = tuple[NetworkOde, Array]


def trained(seed: int, kind: type[Hybrid | NeuralOde] = Hybrid, inputs: tuple[str, ...] = BOTH) -> Trained:
    rng = np.random.default_rng(seed)
    network = TanhNetwork.zero(10, inputs, SCALING)
    parameters = np.array([0.15, 0.012, 0.0025, 0.02]) * rng.uniform(0.5, 2.0, (FANS, 4))
    return kind(network.with_theta(rng.normal(size=network.parameter_count))), parameters


@pytest.mark.parametrize(("kind", "inputs"), [(Hybrid, ("speed",)), (NeuralOde, BOTH)])
def test_its_acceleration_is_the_mean_of_theirs_and_its_lag_too(kind, inputs: tuple[str, ...]) -> None:
    members = [trained(seed, kind, inputs) for seed in range(4)]
    model, parameters = mean_model(members)
    rng = np.random.default_rng(9)
    speed_rad_s, command = rng.uniform(-20.0, 200.0, (50, FANS)), rng.uniform(-0.2, 1.2, (50, FANS))
    theirs = [one.equation(own).acceleration(speed_rad_s, command) for one, own in members]
    np.testing.assert_allclose(
        model.equation(parameters).acceleration(speed_rad_s, command), np.mean(theirs, axis=0), rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(parameters[:, LAG], np.mean([own[:, LAG] for _, own in members], axis=0))
