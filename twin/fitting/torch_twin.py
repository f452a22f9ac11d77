"""A trained twin as a module of PyTorch, differentiable by speeds, commands, physics and weights.

The outlook of Peng and Chen is control by the twin: a gradient through its free run says how commands should change.
"""

from pathlib import Path

import numpy as np
import torch

from fantwin.schemas.twin_card import TwinCard
from fantwin.twin.errors import TwinError
from fantwin.twin.export.onnx_twin import stored_ode
from fantwin.twin.fitting.torch_reference import torch_acceleration, torch_free_run
from fantwin.twin.models.drive import SMALLEST_STEP_S, Drive, drive_settings
from fantwin.twin.models.fan_ode import FanOde
from fantwin.twin.models.physics import LAG

FASTEST = 1.5
"""highest initial speed, relative to that of the training data"""
MOST_STEPS = 1000
"""largest number of steps in a period, as in a running site (pipeline.prediction.free_run)"""


class TorchTwin(torch.nn.Module):
    """The right-hand side and the free run of a twin, as its ONNX file computes them, in float64.

    Attributes:
        physics: parameter (fans, 3), J, alpha and C_D relative to those of the twin: at first all 1. A drag higher by
            30 % is `physics[:, 2] = 1.3`. None without physics.
        weights: parameter (P,), of the network for inputs in rad/s and command units. None without a network.

    Conditions are the reference conditions of the twin, speeds those of the rotor and not of a tacho.
    """

    physics: torch.nn.Parameter | None
    weights: torch.nn.Parameter | None
    _trained: torch.Tensor

    def __init__(self, model: FanOde, card: TwinCard) -> None:
        """Use `Twin.as_torch`. card: of the twin; its parameters are (fans, 4), behind a drive (fans, 7)."""
        super().__init__()
        parameters = np.array(card.parameters, np.float64)
        self._model, self._rate_hz, self._top_speed_rad_s = model, card.rate_hz, card.top_speed_rad_s
        self._lag_s, self._settings = parameters[:, LAG], drive_settings(parameters)
        trained = torch.from_numpy(parameters[:, :LAG].copy())
        self.register_buffer("_trained", trained)
        self.physics = torch.nn.Parameter(torch.ones_like(trained)) if model.has_physics else None
        self.weights = torch.nn.Parameter(torch.from_numpy(model.theta.copy())) if model.network else None

    def forward(self, speed: torch.Tensor, command: torch.Tensor) -> torch.Tensor:
        """(..., fans) acceleration in rad/s^2 at speeds in rad/s and commands that act, (..., fans) each.

        The command that acts is the one after the drive and the lag; in `free_run` both are included.
        """
        return torch_acceleration(self._model, self._theta, self._of_fans, speed, command)

    def free_run(self, initial_speed: torch.Tensor, commands: torch.Tensor, period_s: float) -> torch.Tensor:
        """(n, fans) speeds in rad/s at each sample, before its command acts: the first is the initial speed.

        initial_speed: (fans,), rad/s, of fans that have run for long at the first command. commands: (n, fans), each
        held for period_s. Of a twin of one fan there may be any number of fans. One step of Runge-Kutta takes as long
        as in training, or the period if that is shorter.

        Raises:
            TwinError: a shape, or the initial speed, cannot be right.
        """
        self._require_possible(initial_speed, commands, period_s)
        steps = max(1, round(min(period_s * self._rate_hz, MOST_STEPS)))
        step_s = period_s / steps
        held = commands.repeat_interleave(steps, dim=0)
        acting = self._lagged(self._driven(held, self._model.drive, step_s), commands[0], step_s)
        each_s = torch.full((len(held),), step_s, dtype=commands.dtype)
        speeds = torch_free_run(self._model, self._theta, self._of_fans, initial_speed, acting, each_s)
        return speeds[::steps]

    def _require_possible(self, initial_speed: torch.Tensor, commands: torch.Tensor, period_s: float) -> None:
        fans, known = commands.shape[-1] if commands.ndim else 0, len(self._trained)
        number = known if known > 1 else fans
        if commands.ndim != 2 or fans != number or not len(commands):
            raise TwinError(f"commands must be (n, {known if known > 1 else 'fans'}), not {tuple(commands.shape)}")
        if not isinstance(initial_speed, torch.Tensor) or initial_speed.shape != (fans,):
            shape = tuple(initial_speed.shape) if isinstance(initial_speed, torch.Tensor) else f"{initial_speed!r}"
            raise TwinError(f"initial_speed must be a tensor ({fans},), a speed for each fan, not {shape}")
        if not (initial_speed.abs() <= FASTEST * self._top_speed_rad_s).all():
            raise TwinError(
                f"initial_speed is {initial_speed.detach().abs().max():.4g}, and the twin knows speeds up to "
                f"{self._top_speed_rad_s:.4g} rad/s: convert it to rad/s"
            )
        if not (commands.isfinite().all() and 0.0 < period_s < np.inf):
            raise TwinError(f"commands must be finite, and period_s a time in s, not {period_s!r}")

    @property
    def _theta(self) -> torch.Tensor:
        return self._trained.new_zeros(0) if self.weights is None else self.weights

    @property
    def _of_fans(self) -> torch.Tensor:
        return self._trained if self.physics is None else self.physics * self._trained

    def _driven(self, commands: torch.Tensor, drive: Drive | None, step_s: float) -> torch.Tensor:
        """twin.models.drive.Drive once more: (n, fans) what the drive makes of commands."""
        if drive is None:
            return commands
        lowest, friction, kick = torch.from_numpy(self._settings.T.copy())
        full, charge, effective = drive.turning_command, commands[0], []
        rise, fall = step_s * full / drive.kick_s, step_s * full / drive.rest_s
        per_step = drive.kick_s / full / max(step_s, SMALLEST_STEP_S)
        for command in commands:
            is_on, charge = command >= full, charge.clamp(max=full)
            share = ((full - charge) * per_step).clamp(max=1.0)
            charge = torch.where(is_on, (charge + rise).clamp(max=full), (charge - fall).clamp(min=0.0))
            wanted = torch.maximum(command, lowest)
            effective.append(torch.where(is_on, wanted + share * (kick - wanted) - friction, 0.0))
        return torch.stack(effective)

    def _lagged(self, commands: torch.Tensor, lagged: torch.Tensor, step_s: float) -> torch.Tensor:
        """twin.models.lag once more: (n, fans) the commands that act. lagged: (fans,) before the first."""
        if not self._lag_s.any():
            return commands
        with np.errstate(divide="ignore"):
            steps = step_s / self._lag_s
        decay, mean_share = torch.from_numpy(np.exp(-steps)), torch.from_numpy(-np.expm1(-steps) / steps)
        acting = []
        for command in commands:
            acting.append(command + (lagged - command) * mean_share)
            lagged = command + (lagged - command) * decay
        return torch.stack(acting)


def torch_twin(content: bytes, card: TwinCard) -> TorchTwin:
    """The module of a twin file. card: that of the file.

    Raises:
        TwinError: the twin is not continuous in time.
    """
    model = stored_ode(Path("the twin"), content, card)
    return TorchTwin(model, card)
