"""Operation of the fans within a bin: speed, movement and load of each fan, and what its tacho has shown."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.model.bins import Bin
from fantwin.scoring.saved import Saved

BACKLASH = 0.01
"""share of the top speed, or of the largest command, below which a movement is ignored: a speed loop makes it from the
noise of its tacho"""
FASTEST = 2.0
"""multiple of the top speed beyond which a free run has diverged"""
LOWEST_ERROR = 0.01
"""standard deviation of the lowest command that acts, share of the commands"""
STEADY_S = 0.5
"""time constant by which the measured speed is averaged where the torque balance is read: it removes what a speed loop
does around a speed"""


@dataclass(frozen=True, eq=False)
class Fans:
    """Fans of a tray as the twin's card has them, (fans,) each. Torque is in the unit of the command."""

    top_rad_s: Array
    inertia: Array
    viscous: Array
    drag: Array
    friction: Array
    noise_rad_s: Array
    """standard deviation of one reading"""
    pulse_rad_s: Array
    """speed of one pulse more in a count; 0: the tacho does not count"""
    held_s: Array
    """time for which a tacho holds a reading"""
    adjoins: Array
    """true if each count begins where the one before ended"""
    timing_s: Array
    """standard deviation of the time of a reading"""
    coasts_s: Array
    """time for which a fan without power turns on: the integral of its speed over that before"""
    balance_noise: Array
    """standard deviation of the healthy torque balance"""
    balance_filter_per_s: float
    lowest_command: Array
    """a smaller one acts as this one; NaN: there is none"""
    commands: float
    """range of the commands that the twin was trained on"""
    has_own_drive: Array
    """true if it controls its speed by itself, so that the torque of the card is no torque of its motor"""
    may_have_plateau: Array
    """true if its speed may be constant below some command, of which the twin knows nothing"""
    may_be_ahead: Array
    """true if a rotor may be ahead of its twin after a movement of the command; the range of readings of a
    static twin has that"""
    prefers_balance: Array
    """true if the torque balance is read, and not the speed, where both are known"""

    @property
    def reads_balance(self) -> Array:
        """Return where the torque balance can be read, (fans,): a reading that is held steps, and a step is an impulse
        of the balance."""
        return np.asarray(self.held_s == 0.0)

    def of(self, fans: Array) -> Fans:
        """Select some fans, (n,) by number."""
        return replace(self, **{name: each[fans] for name, each in vars(self).items() if isinstance(each, np.ndarray)})

    def slope(self, speed_rad_s: Array) -> Array:
        """Slope of the torque that a fan needs, over its speed."""
        return np.maximum(self.viscous + 2.0 * self.drag * speed_rad_s, 1e-9)


@dataclass(frozen=True, eq=False)
class Inputs:
    """Inputs of the model within a bin, (fans,) each."""

    speed_rad_s: Array
    """speed of the twin; where the torque balance is used, the measured one"""
    measured_rad_s: Array
    newest_rad_s: Array
    """the newest reading; NaN without one"""
    rate_rad_s2: Array
    moved_to_rad_s: Array
    """speed, followed with BACKLASH, so that the noise of a tacho is no movement"""
    moves_rad_s2: Array
    """rate of that speed"""
    load: Array
    """mean of the squares of the shares of the top speed of the other fans of the tray"""
    command_path: Array
    """movement of the command so far, share of the largest command so far"""
    command_moved: Array
    """share that it has moved by more than BACKLASH"""
    unseen_rad_s: Array
    """standard deviation of the twin's error where it was not trained"""
    of_lowest_rad_s: Array
    """standard deviation of its error near the command from which on the speed rises, and below it"""
    half_range_rad_s: Array
    readings: Array
    """number of readings that end in the bin; 0: nothing new is known"""
    is_new: Array
    """true where a reading ends that its tacho holds"""
    ends: Array
    """true where a reading ends, seen or not"""
    changes: Array
    """true where the tacho has shown another reading within the bin"""
    deviation_rad_s: Array
    """distance from the free run; or what it would be at a steady speed by the torque balance"""
    is_balance: Array
    """true where the torque balance is read, and not the speed"""

    def of(self, fans: Array) -> Inputs:
        """Inputs of some fans, (n,) by number."""
        return Inputs(**{name: each[fans] for name, each in vars(self).items()})


class Operation(Saved):
    """Follows the fans of one tray from bin to bin."""

    KEPT = ("t_ns", "_held", "_speed", "_was_balance", "_moved_to", "_command", "_largest")

    def __init__(self, fans: Fans, bin_ns: int) -> None:
        """Begin with fans that stand."""
        count = len(fans.top_rad_s)
        self._fans, self._bin_ns, self._bin_s = fans, bin_ns, bin_ns / NS_PER_S
        self.bins_held = np.maximum(np.round(fans.held_s / self._bin_s), 1).astype(np.int64)
        """(fans,) number of bins for which a reading is held"""
        self._held = np.zeros((3, count))
        """(3, fans) readings that have not counted yet: number, sum of deviations, sum of half ranges"""
        self.t_ns = 0
        """end of the last bin; 0: there was none"""
        self._speed, self._was_balance = np.zeros(count), np.zeros(count, np.bool_)
        self._moved_to = np.zeros(count)
        self._command, self._largest = np.zeros((2, count)), np.full(count, 1e-9)
        """(2, fans) command of the last bin, as it acts and as far as it moved by more than BACKLASH; the largest"""

    def inputs(self, one: Bin) -> Inputs:
        """Inputs of a bin; bins come in order of time."""
        fans = self._fans
        predicted = np.where(np.isfinite(one.predicted_rad_s), np.abs(one.predicted_rad_s), self._speed)
        predicted = np.minimum(predicted, FASTEST * fans.top_rad_s)
        measured = np.where(np.isfinite(one.measured_rad_s), np.abs(one.measured_rad_s), predicted)
        is_balance = (one.balances > 0) & (fans.prefers_balance | (one.readings == 0))
        steady = np.where(self._was_balance, self._speed, measured)
        steady = steady + (measured - steady) * -np.expm1(-self._bin_s / STEADY_S)
        speed = np.where(is_balance, steady, predicted)
        backlash = BACKLASH * fans.top_rad_s
        moved_to = np.clip(self._moved_to, speed - backlash, speed + backlash)
        follows = one.t_ns - self.t_ns == self._bin_ns
        rate = np.where(follows & (self._was_balance == is_balance), speed - self._speed, 0.0) / self._bin_s
        moves = (moved_to - self._moved_to) / self._bin_s if follows else np.zeros(len(speed))
        share = np.square(speed / fans.top_rad_s)
        self._largest = np.maximum(self._largest, np.abs(one.command))
        slack = BACKLASH * self._largest
        acting = np.fmax(one.command, fans.lowest_command)
        command = np.stack((acting, np.clip(self._command[1], acting - slack, acting + slack)))
        command_path, command_moved = np.abs(command - self._command) / self._largest
        self.t_ns, self._speed, self._was_balance, self._moved_to = one.t_ns, speed, is_balance, moved_to
        self._command = command
        readings = np.where(is_balance, one.balances, one.readings)
        ends = (one.t_ns // self._bin_ns) % self.bins_held == 0
        slope = fans.slope(speed)
        unseen = np.where(is_balance, one.unseen_balance_command / slope, one.unseen_rad_s)
        return Inputs(
            speed,
            measured,
            one.newest_rad_s,
            rate,
            moved_to,
            moves,
            (share.sum() - share) / max(len(share) - 1, 1),
            command_path,
            command_moved,
            unseen,
            self._of_lowest(one.command),
            one.half_range_rad_s,
            readings,
            ends & (self._held[0] + readings > 0.0),
            ends,
            np.asarray(one.another.any(axis=0)),
            np.where(is_balance, -one.balance_command / slope, one.deviation_rad_s),
            is_balance,
        )

    def _of_lowest(self, command: Array) -> Array:
        """Error of the speed near the command from which on it rises, (fans,): the twin knows it to LOWEST_ERROR.

        The curve of a fan bends sharply there, that of a twin is smooth. On simulated racks the bend was found 0.004
        above to 0.014 of the commands below the true one.
        """
        fans = self._fans
        error = LOWEST_ERROR * fans.commands
        slope = fans.top_rad_s / np.maximum(fans.commands - fans.lowest_command, error)
        beyond = np.maximum(command - fans.lowest_command, 0.0)  # below it the speed is that of its end
        near = np.exp(-0.5 * np.square(beyond / (2.0 * error)))
        return np.nan_to_num(error * slope * near)

    def samples_rad_s(self, one: Bin, now: Inputs) -> Array:
        """Deviation of each sample of a bin, (n, fans), as that of its inputs; NaN where there is none."""
        balances = -one.balances_command / self._fans.slope(now.speed_rad_s)
        found: Array = np.where(now.is_balance, balances, one.deviations_rad_s)
        return found

    def read(self, one: Bin, now: Inputs, counts: Array) -> Inputs:
        """Return the inputs with the readings that end now and count: a reading that is held counts once.

        counts: (n, fans) samples of the bin.
        """
        held = self._held
        held[0] += counts.sum(axis=0)
        held[1] += np.where(counts, self.samples_rad_s(one, now), 0.0).sum(axis=0)
        held[2] += np.where(counts, one.half_ranges_rad_s, 0.0).sum(axis=0)
        means = held[1:] / np.maximum(held[0], 1.0)
        readings = held[0] * now.is_new
        held *= ~now.is_new
        return replace(now, readings=readings, deviation_rad_s=means[0], half_range_rad_s=means[1])
