"""One model for the mean of several trainings.

A network is fitted well where there are data, and goes where its start happened to point elsewhere. The mean over
independent starts keeps what they have in common (Lakshminarayanan et al., NeurIPS 2017). Under one effective command
the acceleration is linear in the outputs of the networks and in 1/J, alpha/J and C_D/J, so the mean of accelerations is
a model of the same kind, with the units of all networks side by side. Lags are averaged, which is an approximation
where they differ.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fantwin.twin.models.fan_ode import NetworkOde
from fantwin.twin.models.network import TanhNetwork
from fantwin.twin.models.physics import LAG
from fantwin.twin.runs import Array


def mean_model(trained: Sequence[tuple[NetworkOde, Array]]) -> tuple[NetworkOde, Array]:
    """The model of the mean acceleration, and its parameters (fans, 4). trained: models and their parameters."""
    model, parameters = trained[0]
    if any(np.any(one.theta) for one, _ in trained[1:]):
        model = replace(model, network=_mean_network([one.network for one, _ in trained]))
    if any(np.any(own != parameters) for _, own in trained[1:]):  # equal ones stay equal to the bit
        parameters = _mean_physics(np.array([own for _, own in trained]))
    return model, parameters


def _mean_network(networks: Sequence[TanhNetwork]) -> TanhNetwork:
    of_each = [network.weights() for network in networks]
    input_weights, input_bias, output_weights = (
        np.concatenate([weights[part] for weights in of_each], axis=-1) for part in range(3)
    )
    output_bias = np.mean([weights[3] for weights in of_each])
    theta = np.concatenate((input_weights.ravel(), input_bias, output_weights / len(networks), [output_bias]))
    return replace(networks[0], units=len(input_bias), theta=theta)


def _mean_physics(parameters: Array) -> Array:
    """(fans, 4) of (trainings, fans, 4)."""
    inertia = 1.0 / np.mean(1.0 / parameters[..., 0], axis=0)
    dampings = inertia[:, np.newaxis] * np.mean(parameters[..., 1:LAG] / parameters[..., :1], axis=0)
    return np.column_stack((inertia, dampings, parameters[..., LAG].mean(axis=0)))
