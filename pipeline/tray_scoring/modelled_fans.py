"""What the model of a healthy fan takes from the card of its twin."""

from __future__ import annotations

import math

import numpy as np

from fantwin.pipeline.prediction.tray_twin import TrayTwin
from fantwin.schemas.messages import Array
from fantwin.scoring.model.operation import Fans

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
