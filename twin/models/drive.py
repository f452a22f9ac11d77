"""The drive of a fan that controls its own speed: what it makes of the command before that acts on the rotor.

A 4-pin fan stops below a command, keeps a minimum speed below another, and gives its rotor a kick at each start. With
the command u and the share s of the time for which the kick lasts, between two samples,

    u >= turning_command:   effective = p + s (kick_command - p) - friction,    p = max(u, lowest_command)
    below it:               effective = 0

A kick lasts kick_s, if the drive was off for rest_s before, and less in proportion if it was off for less. The state is
a *charge* between 0 and turning_command: it rises to that within kick_s while the drive is on, and the kick lasts until
then; it falls to 0 within rest_s while the drive is off. A charge that is a command, as at the start of a free run, is
full where that command turns the fan.

As the lag that follows it (twin.models.lag), all of this depends on commands alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fantwin.schemas.twin_card import StateLayout
from fantwin.twin.models.onnx_nodes import Nodes
from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.runs import Array

DRIVE_PARAMETERS = ("lowest_command", "friction", "kick_command")
"""A fan's own, after those of its physics."""
DRIVE_LAYOUT = StateLayout(speed=1, command=2)
"""The commands are the lagged one and the charge."""
SMALLEST_STEP_S = 1e-30
"""A step of zero counts as this long."""


@dataclass(frozen=True)
class Drive:
    """What the drives of the fans of a twin have in common. All three are positive."""

    turning_command: float
    kick_s: float
    rest_s: float

    def kick(self, command: Array, step_s: Array, charge: Array) -> tuple[Array, Array]:
        """(n, batch) share of each step for which the kick lasts, and the charge (batch,) after the last step.

        command: (n, batch). step_s: (n, batch) or (n, 1). charge: (batch,) before the first step.
        """
        full = self.turning_command
        is_on = self.is_on(command)
        rise, fall = step_s * (full / self.kick_s), step_s * (full / self.rest_s)
        step_s = np.maximum(step_s, SMALLEST_STEP_S)
        share = np.empty_like(command)
        for k in range(len(command)):
            charge = np.minimum(charge, full)
            share[k] = np.minimum((full - charge) * (self.kick_s / full) / step_s[k], 1.0)
            charge = np.where(is_on[k], np.minimum(charge + rise[k], full), np.maximum(charge - fall[k], 0.0))
        return np.where(is_on, share, 0.0), charge

    def is_on(self, command: Array) -> NDArray[np.bool_]:
        """Which commands turn the fans."""
        return command >= self.turning_command

    def effective(self, command: Array, share: Array, settings: Array) -> Array:
        """(n, batch) the command that acts. share: (n, batch), of the kick. settings: (batch, 3) DRIVE_PARAMETERS."""
        lowest, friction, kick = settings.T
        wanted = np.maximum(command, lowest)
        return np.where(self.is_on(command), wanted + share * (kick - wanted) - friction, 0.0)

    def by_settings(self, command: Array, share: Array, settings: Array) -> Array:
        """(n, batch, 3) derivatives of the effective command by the settings."""
        at_lowest = (1.0 - share) * (command < settings[:, 0])
        derivatives = np.stack((at_lowest, np.full_like(command, -1.0), share), axis=-1)
        return np.where(self.is_on(command)[..., np.newaxis], derivatives, 0.0)

    def run_effective(self, command: Array, step_s: Array, settings: Array) -> Array:
        """(n, fans) the command that acts over a run (n, fans), which starts with a drive that has settled."""
        share, _ = self.kick(command, step_s[:, np.newaxis], command[0])
        return self.effective(command, share, settings)

    def nodes(self, body: Nodes, settings: list[str]) -> tuple[str, str]:
        """`kick` and `effective` for one sample: the command that acts (1, fans), and the charge after the step.

        body has command_k (fans,), charge_k (1, fans) and step_k (1, 1). settings: names of rows (1, fans).
        """
        lowest, friction, kick = settings
        full = body.constant("full_charge", self.turning_command)
        none = body.constant("nothing", 0.0)
        charge = body.add("Min", ["charge_k", full], "charge")
        step = body.add("Max", ["step_k", body.constant("shortest_step_s", SMALLEST_STEP_S)], "kick_step")
        per_charge = body.constant("kick_s_per_charge", self.kick_s / self.turning_command)
        left = body.add("Mul", [body.add("Sub", [full, charge], "missing_charge"), per_charge], "kick_left")
        most = body.constant("whole_step", 1.0)
        share = body.add("Min", [body.add("Div", [left, step], "kick_steps"), most], "kick_share")
        wanted = body.add("Max", ["command_k", lowest], "wanted")
        pull = body.add("Mul", [share, body.add("Sub", [kick, wanted], "kick_excess")], "kick_pull")
        driven = body.add("Sub", [body.add("Add", [wanted, pull], "kicked"), friction], "driven")
        is_off = body.add("Less", ["command_k", full], "is_off")
        rate, fall_rate = self.turning_command / self.kick_s, self.turning_command / self.rest_s
        rise = body.add("Mul", ["step_k", body.constant("charge_rate", rate)], "charge_rise")
        fall = body.add("Mul", ["step_k", body.constant("discharge_rate", fall_rate)], "charge_fall")
        risen = body.add("Min", [body.add("Add", [charge, rise], "charging"), full], "charged")
        fallen = body.add("Max", [body.add("Sub", [charge, fall], "discharging"), none], "discharged")
        charge_after = body.add("Where", [is_off, fallen, risen], "charge_next")
        return body.add("Where", [is_off, none, driven], "effective"), charge_after


def drive_settings(parameters: Array) -> Array:
    """(batch, 3) DRIVE_PARAMETERS of parameters (batch, 7)."""
    return parameters[:, len(PARAMETER_NAMES) :]
