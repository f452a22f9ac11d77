"""Facts about the twin of a tray that its scorer uses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import ValidationError

from fantwin.pipeline.prediction.tray_twin import TrayTwin
from fantwin.pipeline.runtime.stage import Context, StageError
from fantwin.pipeline.tray_scoring.modelled_fans import modelled_fans
from fantwin.pipeline.tray_scoring.scorer_config import FALSE_ALARMS_PER_DAY
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import S_PER_DAY
from fantwin.scoring.calibration.calibration import Calibration
from fantwin.scoring.diagnosis.steady_fan import SteadyFan
from fantwin.scoring.diagnosis.what_would_tell import Advice
from fantwin.scoring.model.operation import Fans
from fantwin.scoring.model.priors import Priors
from fantwin.scoring.unseen_error import UnseenError


@dataclass(frozen=True, eq=False)
class HealthyTwin:
    """What the scorer knows about the twin. sha256: identifies its file."""

    sha256: str
    fans: Fans
    steady_fans: Sequence[SteadyFan]
    tachos: Sequence[Tacho]
    """the tacho of each fan"""
    advice: Advice = Advice()
    standstill: Standstill | None = None
    unseen_error: UnseenError | None = None
    """error of the twin where it was not trained; None: its card says nothing about it"""
    has_supply: bool = False
    """whether it needs the supply voltage, and so allows for it"""
    priors: Priors = Priors()
    limit_factor: float = 1.0
    declared_per_day: float = FALSE_ALARMS_PER_DAY
    is_calibrated: bool = False

    @property
    def declared_s(self) -> float:
        """The mean time between two false alarms of a fan."""
        return S_PER_DAY / self.declared_per_day


def healthy_twin(context: Context, twin: TrayTwin) -> HealthyTwin:
    """What a scorer needs to know about the twin of its tray.

    Raises:
        StageError: the twin's calibration cannot be used.
    """
    name = context.tray.twin or twin.card.name
    try:
        return known_of(twin, context.config.false_alarms_per_day)
    except ValidationError as error:
        first = error.errors()[0]
        why = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        again = "calibrate it again: fantwin calibrate"
        raise StageError(f"{name}: its calibration cannot be used: {why}; {again}") from error


def known_of(twin: TrayTwin, declared_per_day: float | None = None) -> HealthyTwin:
    """What the card of a twin tells. declared_per_day: instead of the declared rate of its calibration.

    Raises:
        ValidationError: its calibration is not valid.
    """
    card, fans = twin.card, modelled_fans(twin)
    calibration = Calibration.model_validate(card.calibration) if card.calibration is not None else None
    declared = calibration.false_alarms_per_day if calibration else FALSE_ALARMS_PER_DAY
    lowest_command = card.standstill.turning_command if card.standstill else 0.0
    columns = (fans.viscous, fans.drag, fans.friction, fans.top_rad_s, fans.has_own_drive)
    return HealthyTwin(
        twin.sha256,
        fans,
        [SteadyFan(*each) for each in zip(*(column.tolist() for column in columns), strict=True)],
        twin.tachos,
        Advice(card.command_unit, lowest_command, card.command_range[1] if card.command_range else math.inf),
        card.standstill,
        twin.unseen_error,
        card.conditions is not None and card.conditions.supply_voltage_v is not None,
        calibration.priors if calibration else Priors(),
        calibration.limit_factor if calibration else 1.0,
        declared_per_day or declared,
        calibration is not None,
    )
