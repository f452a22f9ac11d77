"""How far a twin may be wrong where its healthy runs do not show it: where it was not trained, where a drive bends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.messages import Array, Prediction
from schemas.model_uncertainty import ModelUncertainty
from schemas.twin_card import DriveCard

RANGE_STDS = 3.0
"""how far an error may be, in its standard deviations"""
PLATEAU_END_ERROR = 0.01
"""of the range of commands: so far from the truth the end of a fan's plateau often is; on simulated racks it was found
0.004 above to 0.014 below"""
AROUND_ITS_END = (-1.0, 2.0)
"""times that error: the commands around the end of a plateau that it matters for"""


@dataclass(frozen=True, eq=False)
class UnseenError:
    """Standard deviations of a twin's own error. table, drive: of its card, None where it has none. viscous, drag:
    (fans,) of the torque balance. command_width: of the range of training.

    The table is asked at pairs of speed and command of a healthy fan. A fault takes a fan to pairs that nobody has seen
    either, and must not widen its own limits.
    """

    table: ModelUncertainty | None
    drive: DriveCard | None
    viscous: Array
    drag: Array
    command_width: float

    def of_fans(self, rows: Sequence[int]) -> UnseenError:
        """That of the fans in these rows."""
        return replace(
            self,
            table=self.table and self.table.of_fans(rows),
            drive=self.drive and self.drive.of_fans(rows),
            viscous=self.viscous[rows],
            drag=self.drag[rows],
        )

    def of(self, prediction: Prediction) -> tuple[Array, Array]:
        """(n, fans) each, of the predicted speed, rad/s, and of the torque balance, in the unit of the command.

        0 without a prediction or a reading.
        """
        of_speed, of_balance = self._of_table(prediction)
        if self.drive is not None:
            of_end = self._of_plateau_end(prediction.command, self.drive)
            if of_end.any():
                slope = self._needed_by_speed(prediction.predicted_speed_rad_s)
                known = np.isfinite(slope) & (slope > 0.0)
                of_speed = np.hypot(of_speed, np.divide(of_end, slope, out=np.zeros(of_end.shape), where=known))
                of_balance = np.hypot(of_balance, of_end)
        return of_speed, of_balance

    def _of_table(self, prediction: Prediction) -> tuple[Array, Array]:
        """The balance may be wrong in what this command does to a healthy fan, and in what a healthy fan needs at the
        measured speed. An error of the speed counts as that of the command which keeps a fan at the speed.
        """
        measured_rad_s, command = prediction.measured_speed_rad_s, prediction.command
        nowhere = np.zeros(command.shape)
        if self.table is None:
            return nowhere, nowhere
        commands = np.stack((command, command - prediction.torque_balance_command))
        if self.drive is not None:
            commands = self.drive.raised(commands)
        speeds_rad_s = np.stack((prediction.predicted_speed_rad_s, measured_rad_s))
        unseen_rad_s = self.table.unseen_std_at(speeds_rad_s, commands)
        if not unseen_rad_s.any():
            return nowhere, nowhere
        of_speed, of_needed = np.nan_to_num(unseen_rad_s)
        slope = np.maximum(self._needed_by_speed(measured_rad_s), 0.0)
        return of_speed, np.nan_to_num(slope * np.hypot(of_speed, of_needed))

    def _of_plateau_end(self, command: Array, drive: DriveCard) -> Array:
        """(n, fans) in the unit of the command: a plateau ends sharply, and the curve of a twin is smooth."""
        error = PLATEAU_END_ERROR * self.command_width
        beyond = command - np.array(drive.lowest_command)
        low, high = (times * error for times in AROUND_ITS_END)
        return np.where((beyond >= low) & (beyond <= high), error / RANGE_STDS, 0.0)

    def _needed_by_speed(self, speed_rad_s: Array) -> Array:
        """How the command that a fan needs rises with its speed."""
        return self.viscous + 2.0 * self.drag * np.abs(speed_rad_s)
