"""Facts about the twin of a tray that its scorer uses, and what the model of a healthy fan takes from its card."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from fantwin.pipeline.prediction.tray_twin import TrayTwin, for_fans
from fantwin.pipeline.runtime.stage import Context, StageError
from fantwin.pipeline.tray_scoring.scorer_config import FALSE_ALARMS_PER_DAY
from fantwin.schemas.messages import Array
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import S_PER_DAY
from fantwin.scoring.calibration.calibration import Calibration
from fantwin.scoring.diagnosis.ranked_causes import Advice, SteadyFan
from fantwin.scoring.model.operation import Fans
from fantwin.scoring.model.population import Priors
from fantwin.scoring.unseen_error import UnseenError

COUNT_NOISE_RAD_S = 0.8
"""error of a reading that counts pulses, beside what the count misses"""
TIMING_S, TIMING_OF_WINDOW_S = 0.02, 0.1
"""standard deviation of the time of a reading, of a tacho that reads at once and of one that averages over a window"""
COASTS_TO, COAST_POINTS = 0.08, 64
"""share of the top speed to which a coast is followed, and number of steps"""
BALANCE_BETTER = 1.5
"""the torque balance is used where its noise is smaller than that of the speed by this factor"""
LEAST_TORQUE = 0.1
"""share of the range of commands that a fan takes at its top speed at least, whatever its torque balance says"""


def modelled_fans(twin: TrayTwin) -> Fans:
    """The fans of a twin's tray."""
    balance, top, drive = twin.balance, twin.card.top_speed_rad_s, twin.card.drive
    at_once = np.array([tacho.kind == "instantaneous" for tacho in twin.tachos])
    counts = np.array([tacho.kind == "count" for tacho in twin.tachos])
    has_own_drive = (drive is not None) | (counts & (balance.drag.sum() < 0.0))  # such a balance is that of no fan
    pulses = [tacho.resolution_rad_s if tacho.kind == "count" else 0.0 for tacho in twin.tachos]
    viscous, drag = torque_of(twin)
    of_balance = balance.sigma_command / (viscous + drag * top)
    return Fans(
        np.full(twin.fans, top),
        balance.inertia,
        viscous,
        drag,
        balance.friction,
        np.where(at_once, twin.sigma_rad_s, COUNT_NOISE_RAD_S),
        np.array(pulses),
        np.array([tacho.held_s for tacho in twin.tachos]),
        np.array([tacho.window_s == tacho.held_s for tacho in twin.tachos]),
        np.where(at_once, TIMING_S, TIMING_OF_WINDOW_S),
        coasts_s(twin),
        balance.sigma_command,
        balance.filter_rate_per_s,
        np.broadcast_to(drive.lowest_command if drive else math.nan, twin.fans).astype(np.float64),
        float(np.ptp(twin.card.command_range)),
        has_own_drive,
        ~at_once & (drive is None),
        np.full(twin.fans, not twin.card.is_static),
        at_once & (BALANCE_BETTER * of_balance < twin.sigma_rad_s),
    )


def torque_of(twin: TrayTwin) -> tuple[Array, Array]:
    """Viscous and square coefficients of the torque that each fan needs, (fans,): those of the torque balance, if a
    fan with these settles at a speed."""
    balance, top = twin.balance, twin.card.top_speed_rad_s
    drag = np.maximum(balance.drag, 0.0)
    least = LEAST_TORQUE * float(np.ptp(twin.card.command_range)) / top
    return np.maximum(balance.viscous, least - drag * top), drag


def coasts_s(twin: TrayTwin) -> Array:
    """(fans,) how long a fan of a twin turns on without power: as the card tells, or by its torque balance."""
    standstill, balance = twin.card.standstill, twin.balance
    viscous, drag = torque_of(twin)
    if standstill and standstill.coast_time_constant_s:
        return np.full(twin.fans, standstill.coast_time_constant_s)
    speed = np.linspace(1.0, COASTS_TO, COAST_POINTS)[:, np.newaxis] * twin.card.top_speed_rad_s
    slows = ((viscous + drag * speed) * speed + balance.friction) / balance.inertia
    return np.asarray(np.trapezoid(speed / np.maximum(slows, 1e-9), -speed, axis=0)) / twin.card.top_speed_rad_s


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
    loops = for_fans(card.closed_loop or (False,) * card.fans, twin.fans).astype(np.bool_)
    columns = (fans.viscous, fans.drag, fans.friction, fans.top_rad_s, fans.has_own_drive, loops)
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
