"""What drives the model within a bin: speed, movement and load of each fan, and what its tacho has shown."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from bench.detection.one_model.bins import Bin
from pipeline.runtime.tray_twin import TrayTwin
from schemas.messages import Array
from schemas.units import NS_PER_S

BACKLASH = 0.01
"""share of the top speed: a smaller movement may be what a speed loop makes of the noise of its tacho"""
FASTEST = 2.0
"""times the top speed: a free run that is beyond it has diverged"""
COUNT_NOISE_RAD_S = 0.8
"""error of a reading that counts pulses, beside what the count misses"""
COASTS_TO, COAST_POINTS = 0.08, 64
"""share of the top speed to which a coast is followed, and number of steps"""
LOWEST_ERROR = 0.01
"""standard deviation of the lowest command that acts, share of the commands"""
STEADY_S = 0.5
"""time over which the measured speed is averaged where the torque balance is used: that tells what a fan tends to at a
speed, and not what its speed loop does around it"""
BALANCE_BETTER = 1.5
"""the torque balance is used where its noise is smaller than that of the speed by this factor"""


@dataclass(frozen=True, eq=False)
class Fans:
    """What the twin's card tells about the fans of a tray, (fans,) each. Torque is in the unit of the command."""

    top_rad_s: Array
    inertia: Array
    viscous: Array
    drag: Array
    friction: Array
    noise_rad_s: Array
    """standard deviation of one reading"""
    pulse_rad_s: Array
    """what a pulse more in a count is worth; 0: the tacho does not count"""
    held_s: Array
    """how long a tacho holds a reading"""
    coasts_s: Array
    """how long a fan without power turns on: the integral of its speed over that before"""
    balance_noise: Array
    """standard deviation of the healthy torque balance"""
    balance_filter_per_s: float
    lowest_command: Array
    """a smaller one acts as this one; NaN: there is none"""
    commands: float
    """range of the commands that the twin was trained on"""
    has_own_drive: Array
    """whether it controls its speed by itself, so that the torque of the card is no torque of its motor"""
    may_have_plateau: Array
    """whether its speed may stay the same below some command, of which the twin knows nothing"""
    prefers_balance: Array
    """whether the torque balance tells more than the speed, where both are known"""

    @classmethod
    def of_twin(cls, twin: TrayTwin) -> Fans:
        """Those of a twin's tray."""
        balance, top, drive = twin.balance, twin.card.top_speed_rad_s, twin.card.drive
        at_once = np.array([tacho.kind == "instantaneous" for tacho in twin.tachos])
        pulses = [tacho.resolution_rad_s if tacho.kind == "count" else 0.0 for tacho in twin.tachos]
        of_balance = balance.sigma_command / (balance.viscous + balance.drag * top)
        return cls(
            np.full(twin.fans, top),
            balance.inertia,
            balance.viscous,
            balance.drag,
            balance.friction,
            np.where(at_once, twin.sigma_rad_s, COUNT_NOISE_RAD_S),
            np.array(pulses),
            np.array([tacho.held_s for tacho in twin.tachos]),
            coasts_s(twin),
            balance.sigma_command,
            balance.filter_rate_per_s,
            np.broadcast_to(drive.lowest_command if drive else math.nan, twin.fans).astype(np.float64),
            float(np.ptp(twin.card.command_range)),
            np.full(twin.fans, drive is not None),
            ~at_once & (drive is None),
            at_once & (BALANCE_BETTER * of_balance < twin.sigma_rad_s),
        )

    def of(self, fan: int) -> Fans:
        """One of them."""
        return replace(self, **{name: each[[fan]] for name, each in vars(self).items() if isinstance(each, np.ndarray)})

    def slope(self, speed_rad_s: Array) -> Array:
        """How the torque that a fan needs rises with its speed."""
        return np.maximum(self.viscous + 2.0 * self.drag * speed_rad_s, 1e-9)


def coasts_s(twin: TrayTwin) -> Array:
    """(fans,) how long a fan of a twin turns on without power: as the card tells, or by its torque balance."""
    standstill, balance = twin.card.standstill, twin.balance
    if standstill and standstill.coast_time_constant_s:
        return np.full(twin.fans, standstill.coast_time_constant_s)
    speed = np.linspace(1.0, COASTS_TO, COAST_POINTS)[:, np.newaxis] * twin.card.top_speed_rad_s
    slows = ((balance.viscous + balance.drag * speed) * speed + balance.friction) / balance.inertia
    return np.asarray(np.trapezoid(speed / np.maximum(slows, 1e-9), -speed, axis=0)) / twin.card.top_speed_rad_s


@dataclass(frozen=True, eq=False)
class Inputs:
    """What drives the model within a bin, (fans,) each."""

    speed_rad_s: Array
    """speed of the twin; where the torque balance is used, the measured one"""
    measured_rad_s: Array
    newest_rad_s: Array
    """the newest reading; NaN without one"""
    rate_rad_s2: Array
    moved_to_rad_s: Array
    """the speed as far as it has moved by more than what a speed loop makes of the noise of its tacho"""
    moves_rad_s2: Array
    """and its rate"""
    load: Array
    """mean of the squares of the shares of the top speed of the other fans of the tray"""
    turned: Array
    """how far the command has moved, share of the largest command so far"""
    unseen_rad_s: Array
    """standard deviation of the twin's error where it was not trained, and where its lowest command begins to act"""
    half_range_rad_s: Array
    readings: Array
    """0: nothing new is known"""
    deviation_rad_s: Array
    """distance from the free run; or what it would be at a steady speed by the torque balance"""
    is_balance: Array

    def of(self, fan: int) -> Inputs:
        """Those of one fan."""
        return Inputs(**{name: each[[fan]] for name, each in vars(self).items()})


class Operation:
    """Follows the fans of one tray from bin to bin."""

    def __init__(self, fans: Fans, bin_ns: int) -> None:
        """Begin with fans that stand."""
        count = len(fans.top_rad_s)
        self._fans, self._bin_ns, self._bin_s = fans, bin_ns, bin_ns / NS_PER_S
        self.bins_held = np.maximum(np.round(fans.held_s / self._bin_s), 1).astype(np.int64)
        """(fans,) a reading is held for so many bins"""
        self._held = np.zeros((3, count))
        """(3, fans) readings that have not counted yet: number, sum of deviations, sum of half ranges"""
        self._t_ns = 0
        self._speed, self._was_balance = np.zeros(count), np.zeros(count, np.bool_)
        self._moved_to = np.zeros(count)
        self._command, self._largest = np.zeros(count), np.full(count, 1e-9)

    def inputs(self, one: Bin) -> Inputs:
        """Those of a bin; bins come in order of time."""
        fans = self._fans
        predicted = np.minimum(np.abs(one.predicted_rad_s), FASTEST * fans.top_rad_s)
        measured = np.where(np.isfinite(one.measured_rad_s), np.abs(one.measured_rad_s), predicted)
        is_balance = (one.balances > 0) & (fans.prefers_balance | (one.readings == 0))
        steady = np.where(self._was_balance, self._speed, measured)
        steady = steady + (measured - steady) * -np.expm1(-self._bin_s / STEADY_S)
        speed = np.where(is_balance, steady, predicted)
        backlash = BACKLASH * fans.top_rad_s
        moved_to = np.clip(self._moved_to, speed - backlash, speed + backlash)
        follows = one.t_ns - self._t_ns == self._bin_ns
        rate = np.where(follows & (self._was_balance == is_balance), speed - self._speed, 0.0) / self._bin_s
        moves = (moved_to - self._moved_to) / self._bin_s if follows else np.zeros(len(speed))
        share = np.square(speed / fans.top_rad_s)
        self._largest = np.maximum(self._largest, np.abs(one.command))
        turned = np.abs(one.command - self._command) / self._largest
        self._t_ns, self._speed, self._was_balance, self._moved_to = one.t_ns, speed, is_balance, moved_to
        self._command = one.command
        readings, deviation, half_range = self._new_readings(one, speed, is_balance)
        return Inputs(
            speed,
            measured,
            one.newest_rad_s,
            rate,
            moved_to,
            moves,
            (share.sum() - share) / max(len(share) - 1, 1),
            turned,
            np.hypot(one.unseen_rad_s, self._of_lowest(one.command)),
            half_range,
            readings,
            deviation,
            is_balance,
        )

    def _of_lowest(self, command: Array) -> Array:
        """(fans,) error of the speed near the command from which on it rises: the twin knows it to LOWEST_ERROR."""
        fans = self._fans
        error = LOWEST_ERROR * fans.commands
        slope = fans.top_rad_s / np.maximum(fans.commands - fans.lowest_command, error)
        near = np.exp(-0.5 * np.square((command - fans.lowest_command) / (2.0 * error)))
        return np.nan_to_num(error * slope * near)

    def _new_readings(self, one: Bin, speed: Array, is_balance: Array) -> tuple[Array, Array, Array]:
        """Number, mean deviation and mean half range of what counts now: a reading that is held counts once."""
        number = np.where(is_balance, one.balances, one.readings)
        deviation = np.where(is_balance, -one.balance_command / self._fans.slope(speed), one.deviation_rad_s)
        self._held += number * np.stack((np.ones(len(speed)), deviation, one.half_range_rad_s))
        ends = (one.t_ns // self._bin_ns) % self.bins_held == 0
        found = self._held.copy()
        found[0, ~ends] = 0.0
        self._held[:, ends] = 0.0
        means = found[1:] / np.maximum(found[0], 1.0)
        return found[0], means[0], means[1]
