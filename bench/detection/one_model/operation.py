"""What drives the model within a bin: speed, movement and load of each fan, and what its tacho has shown."""

from __future__ import annotations

from dataclasses import dataclass

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
    balance_noise: Array
    """standard deviation of the healthy torque balance"""
    balance_filter_per_s: float
    prefers_balance: Array
    """whether the torque balance tells more than the speed, where both are known"""

    @classmethod
    def of_twin(cls, twin: TrayTwin) -> Fans:
        """Those of a twin's tray."""
        balance, top = twin.balance, twin.card.top_speed_rad_s
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
            balance.sigma_command,
            balance.filter_rate_per_s,
            at_once & (BALANCE_BETTER * of_balance < twin.sigma_rad_s),
        )

    def slope(self, speed_rad_s: Array) -> Array:
        """How the torque that a fan needs rises with its speed."""
        return np.maximum(self.viscous + 2.0 * self.drag * speed_rad_s, 1e-9)


@dataclass(frozen=True, eq=False)
class Inputs:
    """What drives the model within a bin, (fans,) each."""

    speed_rad_s: Array
    """speed of the twin; where the torque balance is used, the measured one"""
    measured_rad_s: Array
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
    half_range_rad_s: Array
    readings: Array
    """0: nothing new is known"""
    deviation_rad_s: Array
    """distance from the free run; or what it would be at a steady speed by the torque balance"""
    is_balance: Array


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
        speed = np.where(is_balance, measured, predicted)
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
            rate,
            moved_to,
            moves,
            (share.sum() - share) / max(len(share) - 1, 1),
            turned,
            one.unseen_rad_s,
            half_range,
            readings,
            deviation,
            is_balance,
        )

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
