"""Adam through torchdiffeq: its fixed-step RK4, gradients by backpropagation through the solver."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torchdiffeq import odeint  # pyright: ignore[reportMissingImports]

from bench.training.race_problem import Phase, Problem, TimedEvaluation
from fantwin.twin.models.hybrid import Hybrid


def speeds(
    model: Hybrid,
    theta: torch.Tensor,
    parameters: torch.Tensor,
    initial: torch.Tensor,
    command: torch.Tensor,
    step_s: float,
) -> torch.Tensor:
    """(n, batch) free run, speeds at each sample. parameters: (batch, 4) or (1, 4). command: (n, batch), held.

    Time is counted in samples; `perturb` keeps the last stage of a step on the command of that step.
    """
    inertia, viscous, drag = parameters.T[:3]
    scale, units = model.network.scaling, model.network.units
    rows, bias = theta[:-1].reshape(-1, units), theta[-1]
    scaled_command = (command - scale.command_offset) / scale.command_scale

    def slope(t: torch.Tensor, speed: torch.Tensor) -> torch.Tensor:
        k = int(t)
        w = (speed - scale.speed_offset_rad_s) / scale.speed_scale_rad_s
        hidden = torch.tanh(w[:, None] * rows[0] + scaled_command[k][:, None] * rows[1] + rows[2])
        known = (command[k] - (viscous + drag * speed.abs()) * speed) / inertia
        return step_s * (known + scale.acceleration_scale_rad_s2 * (hidden @ rows[3] + bias))

    times = torch.arange(len(command), dtype=command.dtype)
    solved = odeint(slope, initial, times, method="rk4", options={"perturb": True})
    assert isinstance(solved, torch.Tensor)
    return solved


def train(problem: Problem, timed: TimedEvaluation, phases: Sequence[Phase]) -> None:
    """Mean square error of stretches with learned initial speeds."""
    scale = problem.model.network.scaling.speed_scale_rad_s
    parameters = torch.from_numpy(problem.identification.parameters)
    theta = torch.from_numpy(problem.model.network.theta.copy()).requires_grad_()
    timed.start()
    for phase in phases:
        command, measured = (torch.from_numpy(values) for values in problem.stretches(phase.stretch))
        initial = (measured[:5].mean(dim=0) / scale).requires_grad_()
        optimiser = torch.optim.Adam([theta, initial], lr=phase.learning_rate)
        while timed.spent_s < phase.until_share * timed.limit_s or phase is phases[-1]:
            optimiser.zero_grad()
            run = speeds(problem.model, theta, parameters, scale * initial, command, problem.step_s)
            loss = ((run - measured) / scale).square().mean()
            loss.backward()
            optimiser.step()
            if timed.due() and timed.finished(theta.detach().numpy()):
                return
