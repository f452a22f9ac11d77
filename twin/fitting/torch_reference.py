"""The published training recipe in torch: Adam on the mean absolute error of the free run, integrated by RK4.

It is the reference for twin.fitting.training, and a second implementation of the same mathematics against which the
exported graph is tested. The recipe: Peng and Chen, equations (28) to (31).
"""

from collections.abc import Sequence

import numpy as np
import torch

from fantwin.twin.evaluation.accuracy import evaluation_pieces
from fantwin.twin.fitting.identification import Identification
from fantwin.twin.fitting.training import SHORT_STRETCH_TIME_CONSTANTS
from fantwin.twin.fitting.trajectories import cut_into_trajectories, stretch_samples
from fantwin.twin.models.fan_ode import FanOde, NetworkOde
from fantwin.twin.models.lag import effective_command
from fantwin.twin.models.physics import LAG
from fantwin.twin.progress import Progress, unreported
from fantwin.twin.runs import Array, Run

LEARNING_RATE, MAX_ITERATIONS = 1e-3, 400


def torch_acceleration(
    model: FanOde, theta: torch.Tensor, parameters: torch.Tensor, speed: torch.Tensor, held: torch.Tensor
) -> torch.Tensor:
    """(..., batch) acceleration in rad/s^2 at speeds and effective commands (..., batch); the others as of
    torch_free_run. right_hand_side.FanEquation once more."""
    known, learned = torch.zeros_like(speed), torch.zeros_like(speed)
    if model.network is not None:
        network, scale = model.network, model.network.scaling
        rows = theta[:-1].reshape(len(network.inputs) + 2, network.units)
        pre = rows[-2] + ((speed - scale.speed_offset_rad_s) / scale.speed_scale_rad_s)[..., None] * rows[0]
        if len(network.inputs) > 1:
            pre = pre + ((held - scale.command_offset) / scale.command_scale)[..., None] * rows[1]
        learned = scale.acceleration_scale_rad_s2 * (torch.tanh(pre) @ rows[-1] + theta[-1])
    if model.has_physics:
        inertia, viscous, drag = parameters.T[:LAG]
        known = (held - viscous * speed - drag * speed * speed.abs()) / inertia
    return known + learned


def torch_free_run(
    model: FanOde,
    theta: torch.Tensor,
    parameters: torch.Tensor,
    initial_speed_rad_s: torch.Tensor,
    command: torch.Tensor,
    step_s: torch.Tensor,
) -> torch.Tensor:
    """(n, batch) speeds of a free run, differentiable by theta.

    theta: (P,). parameters: (batch, 4). initial_speed_rad_s: (batch,). command: (n, batch), the effective one: after
    the lag (lag.effective_command). step_s: (n,) or (n, batch).
    """

    def acceleration(speed: torch.Tensor, held: torch.Tensor) -> torch.Tensor:
        return torch_acceleration(model, theta, parameters, speed, held)

    speeds, speed = [], initial_speed_rad_s
    for held, step in zip(command, step_s, strict=True):
        speeds.append(speed)
        k1 = acceleration(speed, held)
        k2 = acceleration(speed + step / 2 * k1, held)
        k3 = acceleration(speed + step / 2 * k2, held)
        k4 = acceleration(speed + step * k3, held)
        speed = speed + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return torch.stack(speeds)


def train_adam(
    model: NetworkOde,
    runs: Sequence[Run],
    identification: Identification,
    *,
    max_iterations: int,
    progress: Progress = unreported,
) -> tuple[NetworkOde, int]:
    """Train from the model's weights on stretches of ten time constants; returns the best iterate, and max_iterations.

    Each stretch starts from the mean of its first five measured speeds: readings are taken for speeds. The
    model's physics, the lag included, stay as identified.
    """
    pieces = evaluation_pieces(runs)
    period_s = min(piece.median_period_s for piece in pieces)
    longest_s = float(identification.time_constant_s.max())
    data = cut_into_trajectories(pieces, stretch_samples(longest_s, period_s, SHORT_STRETCH_TIME_CONSTANTS))
    measured = _tensor(data.compared)
    speed = _tensor(np.nan_to_num(data.speed_rad_s))
    parameters = identification.parameters[data.fan]
    acting, _ = effective_command(data.command, data.step_s, parameters[:, LAG], data.command_before)
    physics, initial = _tensor(parameters), _tensor(data.starting_speed_rad_s())
    command, steps = _tensor(acting), _tensor(data.step_s)
    theta = _tensor(model.network.theta).requires_grad_()
    optimiser = torch.optim.Adam([theta], lr=LEARNING_RATE)
    best, best_loss = model.network.theta, np.inf
    for iteration in range(1, max_iterations + 1):
        optimiser.zero_grad()
        error = measured * (torch_free_run(model, theta, physics, initial, command, steps) - speed)
        loss = error.abs().sum() / measured.sum()
        if float(loss.detach()) < best_loss:
            best, best_loss = theta.detach().numpy().copy(), float(loss.detach())
        loss.backward()
        optimiser.step()
        rmse_rad_s = float((error.detach().square().sum() / measured.sum()).sqrt())
        progress("training", iteration, max_iterations, rmse_rad_s)
    return model.with_theta(best), max_iterations


def _tensor(values: Array | np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.array(values, dtype=np.float64))
