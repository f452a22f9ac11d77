"""Error that a twin may have where it was not trained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fantwin.schemas.messages import Array, Prediction
from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.schemas.twin_card import DriveCard


@dataclass(frozen=True, eq=False)
class UnseenError:
    """Standard deviations of a twin's own error.

    table, drive: of its card; drive: None where it has none. viscous, drag: (fans,) of the torque balance.

    The table is read only at pairs of speed and command of a healthy fan: a fault takes a fan to unseen pairs, too, and
    must not widen its own limits.
    """

    table: ModelUncertainty
    drive: DriveCard | None
    viscous: Array
    drag: Array

    def of_fans(self, rows: Sequence[int]) -> UnseenError:
        """Error of the fans in these rows."""
        return replace(
            self,
            table=self.table.of_fans(rows),
            drive=self.drive and self.drive.of_fans(rows),
            viscous=self.viscous[rows],
            drag=self.drag[rows],
        )

    def of(self, prediction: Prediction) -> tuple[Array, Array]:
        """Error of the predicted speed, rad/s, and of the torque balance, in the unit of the command, (n, fans) each.

        The balance may be wrong in what this command does to a healthy fan, and in what a healthy fan needs at the
        measured speed. An error of the speed counts as that of the command which keeps a fan at the speed. 0 without a
        prediction or a reading.
        """
        measured_rad_s, command = prediction.measured_speed_rad_s, prediction.command
        nowhere = np.zeros(command.shape)
        commands = np.stack((command, command - prediction.torque_balance_command))
        if self.drive is not None:
            commands = self.drive.raised(commands)
        speeds_rad_s = np.stack((prediction.predicted_speed_rad_s, measured_rad_s))
        unseen_rad_s = self.table.unseen_std_at(speeds_rad_s, commands)
        if not unseen_rad_s.any():
            return nowhere, nowhere
        of_speed, of_needed = np.nan_to_num(unseen_rad_s)
        slope = np.maximum(self.viscous + 2.0 * self.drag * np.abs(measured_rad_s), 0.0)  # of the command, by speed
        return of_speed, np.nan_to_num(slope * np.hypot(of_speed, of_needed))
