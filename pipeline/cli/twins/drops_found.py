"""What a calibrated twin finds, for people: the drops of speed that raise an alarm, in the unit of the tray."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.runtime.tray_twin import load_tray_twin
from scoring.calibration.detectable import SHARES, detectable_drops
from scoring.limits import Limits


@dataclass(frozen=True)
class Drop:
    """Of the fan with the widest limits, in the unit of speeds; infinite where not even standstill raises an alarm."""

    speed: float
    at_once: float
    within_a_minute: float

    def as_json(self) -> dict[str, float | None]:
        """The same for --json, null where not even standstill raises an alarm."""
        return {name: value if np.isfinite(value) else None for name, value in vars(self).items()}


def drops_found(path: Path, rad_s_per_unit: float) -> list[Drop]:
    """The drops at some speeds up to the top speed of training; none without a calibration.

    Raises:
        StageError: the twin cannot be read.
    """
    twin = load_tray_twin(path)
    if twin.card.calibration is None:
        return []
    limits, rad_s = Limits.model_validate(twin.card.calibration), rad_s_per_unit
    speeds = [share * twin.card.top_speed_rad_s for share in SHARES]
    of_fans = [
        detectable_drops(limits.of(range(fan, fan + 1)), float(twin.sigma_rad_s[fan]), balance, speeds)
        for fan, balance in enumerate(twin.healthy_balances())
    ]
    widest = [
        (speed, max(drop.at_once_rad_s for drop in drops), max(drop.within_a_minute_rad_s for drop in drops))
        for speed, drops in zip(speeds, zip(*of_fans, strict=True), strict=True)
    ]
    return [
        Drop(speed / rad_s, *(drop / rad_s if drop <= speed else np.inf for drop in drops)) for speed, *drops in widest
    ]


def drop_lines(drops: Sequence[Drop], unit: str) -> list[str]:
    """One line for each speed."""
    return [f"found at {_of(drop.speed)} {unit}: {_found(drop, unit)}" for drop in drops]


def _found(drop: Drop, unit: str) -> str:
    if not np.isfinite(drop.within_a_minute):
        return "no drop, not even standstill"
    at_once = f"a drop of {_of(drop.at_once)} {unit} at once"
    if not np.isfinite(drop.at_once):
        return f"a drop of {_of(drop.within_a_minute)} {unit} within a minute"
    if drop.within_a_minute > 0.95 * drop.at_once:
        return at_once
    return f"{at_once}, {_of(drop.within_a_minute)} {unit} within a minute"


def _of(value: float) -> str:
    """Two digits of a drop are enough."""
    return f"{value:,.0f}" if value >= 10 else f"{value:.2g}"
