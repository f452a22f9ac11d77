"""The published recipe in torch: Adam at its default rate on the mean absolute error of the free run, by RK4.

Peng and Chen train on the whole free run; stretches of ten time constants side by side, each from the mean of its first
five measured speeds, are the same loss in less time.
"""

from __future__ import annotations

import torch

from bench.training.race_problem import Problem, TimedEvaluation
from fantwin.twin.fitting.torch_reference import LEARNING_RATE, torch_free_run
from fantwin.twin.fitting.training import SHORT_STRETCH_TIME_CONSTANTS
from fantwin.twin.fitting.trajectories import stretch_samples


def train(problem: Problem, timed: TimedEvaluation) -> None:
    """Mean absolute error of stretches from their measured start."""
    longest_s = float(problem.identification.time_constant_s.max())
    stretch = stretch_samples(longest_s, problem.step_s, SHORT_STRETCH_TIME_CONSTANTS)
    command, measured = (torch.from_numpy(values) for values in problem.stretches(stretch))
    parameters = torch.from_numpy(problem.identification.parameters).expand(command.shape[1], -1)
    initial, step_s = measured[:5].mean(dim=0), torch.full((stretch,), problem.step_s, dtype=command.dtype)
    theta = torch.from_numpy(problem.model.network.theta.copy()).requires_grad_()
    optimiser = torch.optim.Adam([theta], lr=LEARNING_RATE)
    timed.start()
    while True:
        optimiser.zero_grad()
        run = torch_free_run(problem.model, theta, parameters, initial, command, step_s)
        (run - measured).abs().mean().backward()
        optimiser.step()
        if timed.due() and timed.finished(theta.detach().numpy()):
            return
