"""What stands for a command that is not known, and how well it predicts the speeds: the same at an import and live.

Many halls measure speed, temperature and current, and no command. A fan is then compared with the other fans of its
tray, which have a command in common, or with a channel that its controller follows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fantwin.pipeline.sources.source import Reading
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.messages import Array
from fantwin.schemas.units import RAD_S_PER_UNIT

OTHERS = "others"
STAND_INS = (OTHERS, *(each.key for each in CHANNELS))
"""values of `command_from`, in the order in which they are offered"""
_NAMES = {each.key: each.name for each in CHANNELS}
KNOTS, FITTED = 8, 2 / 3
"""knots of the curve by which a stand-in is judged, and share of the samples that it is fitted to"""
FEWEST = 30
NOT_FOUND = {
    OTHERS: "what slows most of the fans at once",
    "temperature": "what warms the sensor, too, and other air looks like a fault",
}
"""what a twin by a stand-in cannot find"""
HELD = "drag under a controller that holds the speed"


def stand_in(name: str, speed_rad_s: Array, measured: Mapping[str, Array]) -> Array:
    """(n, fans) what stands for the command: of OTHERS the median speed of the other fans, rpm; else a channel.

    speed_rad_s: (n, fans). measured: by the name of the channel. NaN where nothing is known.
    """
    if name != OTHERS:
        return np.asarray(measured.get(_NAMES[name], np.full(speed_rad_s.shape, np.nan)), np.float64)
    fans = speed_rad_s.shape[1]
    found = np.full(speed_rad_s.shape, np.nan)
    for fan in range(fans):
        others = np.delete(speed_rad_s, fan, axis=1)
        known = np.isfinite(others).any(axis=1)
        found[known, fan] = np.nanmedian(others[known], axis=1) / RAD_S_PER_UNIT["rpm"]
    return found


def with_stand_in(reading: Reading, name: str, rad_s_per_unit: float) -> Reading:
    """The reading with what stands for its command. rad_s_per_unit: of its speeds."""
    speed = np.array([reading.speed], np.float64) * rad_s_per_unit
    measured = {each: np.array([values]) for each, values in reading.measured.items() if values}
    return replace(reading, command=tuple(stand_in(name, speed, measured)[0].tolist()))


@dataclass(frozen=True)
class Predicts:
    """A stand-in, and the error of the speeds by it, rms share of the speed over the last third of the samples."""

    name: str
    error: float

    def words(self, fans: int) -> str:
        """What it is worth and what it does not find."""
        lacks = NOT_FOUND.get(self.name, "what changes it and the speed alike")
        if self.name == OTHERS and fans == 2:
            lacks += ", which of the two fans has the fault"
        return f"--command-from {self.name}, speeds within {self.error:.1%} (held out), not found: {lacks}, and {HELD}"


def stand_ins_of(speed_rad_s: Array, measured: Mapping[str, Array]) -> list[Predicts]:
    """The stand-ins that data have, the best first."""
    found: list[Predicts] = []
    for name in STAND_INS:
        if (name == OTHERS and speed_rad_s.shape[1] < 2) or (name != OTHERS and _NAMES[name] not in measured):
            continue
        command = stand_in(name, speed_rad_s, measured)
        errors = [_error(command[:, fan], speed_rad_s[:, fan]) for fan in range(speed_rad_s.shape[1])]
        if np.isfinite(errors).any():
            found.append(Predicts(name, float(np.nanmedian(errors))))
    return sorted(found, key=lambda each: each.error)


def _error(command: Array, speed_rad_s: Array) -> float:
    """Error of a fan by a straight line between medians of the speed; NaN with too few samples or one command."""
    known = np.isfinite(command) & np.isfinite(speed_rad_s)
    command, speed = command[known], speed_rad_s[known]
    cut = int(FITTED * len(command))
    if len(command) < FEWEST or not np.ptp(command[:cut]) > 0.0 or not np.mean(np.abs(speed[cut:])) > 0.0:
        return np.nan
    groups = np.array_split(np.argsort(command[:cut], kind="stable"), KNOTS)
    knots, speeds = (np.array([np.median(values[:cut][rows]) for rows in groups]) for values in (command, speed))
    residual = speed[cut:] - np.interp(command[cut:], knots, speeds)
    return float(np.sqrt(np.mean(residual**2)) / np.mean(np.abs(speed[cut:])))
