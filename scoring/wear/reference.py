"""What wear is measured against: a healthy fan as a twin describes it, and the fan's own offset from commissioning.

A twin that is trained later takes the wear of a fan up to then for healthy. So the reference of a fan stays that of
the twin with which it was commissioned, also when other twins take over. It holds all that a point depends on: the
coefficients of the torque balance, the balance that calibration expects at each speed, and the fan's offset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from schemas.messages import Array
from scoring.baseline.healthy_residual import HealthyResidual
from scoring.baseline.settings import BaselineSettings
from scoring.baseline.speed_scaling import speed_scaling
from scoring.diagnosis.regression_window import HealthyBalance, Window

_SCALING = ("speed_exponent", "reference_speed_rad_s", "crossover_speed_rad_s")
"""the settings of a baseline that say how an offset changes with the speed"""


@dataclass(frozen=True, eq=False)
class HealthyFan:
    """One healthy fan by a twin and its calibration, in units of the command.

    speeds_rad_s, expected_command: (knots,) the balance that is expected at each speed. offset_scaling: how the offset
    of a fan changes with its speed.
    """

    balance: HealthyBalance
    speeds_rad_s: Array
    expected_command: Array
    offset_scaling: BaselineSettings

    def snapshot(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "balance": {**vars(self.balance), "covariance": self.balance.covariance.tolist()},
            "speeds_rad_s": self.speeds_rad_s.tolist(),
            "expected_command": self.expected_command.tolist(),
            "offset_scaling": self.offset_scaling.model_dump(include=set(_SCALING)),
        }

    @classmethod
    def restore(cls, snapshot: Mapping[str, Any]) -> HealthyFan:
        """That of a snapshot.

        Raises:
            ValueError, KeyError, TypeError: it is not such a snapshot.
        """
        stored = snapshot["balance"]
        names = {field.name for field in fields(HealthyBalance)} - {"covariance"}
        covariance = np.array(stored["covariance"], np.float64)
        speeds_rad_s, expected = (np.array(snapshot[name], np.float64) for name in ("speeds_rad_s", "expected_command"))
        if covariance.shape != (4, 4) or speeds_rad_s.shape != expected.shape or not speeds_rad_s.size:
            raise ValueError("a healthy fan with columns of other lengths")
        numbers = {name: float(stored[name]) for name in names if name in stored}
        balance = HealthyBalance(**numbers, covariance=covariance)
        scaling = BaselineSettings(**{name: snapshot["offset_scaling"][name] for name in _SCALING})
        return cls(balance, speeds_rad_s, expected, scaling)


def healthy_fans(balances: Sequence[HealthyBalance], residual: HealthyResidual) -> list[HealthyFan]:
    """The fans of a tray. residual: the healthy torque balance by calibration."""
    offsets = residual.fan_offsets
    offset_speeds = offsets.speeds_rad_s if offsets else ()
    speeds_rad_s = np.union1d(residual.speeds_rad_s, offset_speeds)
    expected = np.interp(speeds_rad_s, residual.speeds_rad_s, residual.expected_residual_sigmas)
    made = []
    for fan, balance in enumerate(balances):
        own = np.interp(speeds_rad_s, offset_speeds, offsets.offset_sigmas[fan]) if offsets else 0.0
        made.append(HealthyFan(balance, speeds_rad_s, balance.sigma_command * (expected + own), residual.baseline))
    return made


@dataclass(frozen=True, eq=False)
class WearReference:
    """What the wear of one fan is measured against.

    offset_command: of the fan's balance at the end of commissioning, at the reference speed. of_earlier_twin: another
    twin or other limits are in force now, so the reference stays as it is. Until then its offset is the present one:
    commissioning refines it when a fan first runs faster.
    """

    healthy: HealthyFan
    offset_command: float
    of_earlier_twin: bool = False

    def offset_at(self, speed_rad_s: float) -> float:
        """The fan's offset at a speed, in units of the command."""
        speed = np.full((1, 1), speed_rad_s)
        return self.offset_command * float(speed_scaling(self.healthy.offset_scaling, speed, np.isfinite(speed))[0, 0])

    def applied_to(self, window: Window) -> Window:
        """A window with what this reference expects of a healthy fan."""
        speed_rad_s = np.abs(window.speed_rad_s)
        expected = np.interp(speed_rad_s, self.healthy.speeds_rad_s, self.healthy.expected_command)
        return replace(window, fan_offset=self.offset_at(float(window.speed_rad_s[-1])), expected_command=expected)

    def snapshot(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "of_earlier_twin": self.of_earlier_twin,
            "offset_command": self.offset_command,
            "healthy": self.healthy.snapshot(),
        }

    @classmethod
    def restore(cls, snapshot: Mapping[str, Any]) -> WearReference:
        """That of a snapshot.

        Raises:
            ValueError, KeyError, TypeError: it is not such a snapshot.
        """
        healthy = HealthyFan.restore(snapshot["healthy"])
        return cls(healthy, float(snapshot["offset_command"]), bool(snapshot["of_earlier_twin"]))
