"""Moves the commands of fans so that a recording determines their twins: all levels, up and down, long and short.

How long a step lasts follows from the fans: two steps over the whole range show their time constants first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import Array

LEVELS = (0.5, 1.0, 0.25, 0.75, 0.0, 0.6, 0.1, 0.9, 0.35, 0.8, 0.2, 0.65, 0.45)
"""of the range, held until the speed has settled"""
SHORT_LEVELS = (0.2, 0.8, 0.4, 1.0, 0.6, 0.3, 0.9, 0.5, 0.1, 0.7)
"""of the range, held for a time constant: the fan never settles"""
SETTLING = 5.0
"""time constants until a speed has settled"""
SHORTEST_S, LONGEST_S = 0.5, 60.0
"""of a step; a fan that has not settled after the longest is slower than a fan can be"""
SHORTEST_PROBE_S = 3.0
PROBED = 4.0
"""time constants that a probe lasts at least"""
PROBES = 3
"""steps that show the time constants"""
LEAST_SHARE = 0.2
"""of the range: 4-pin fans turn there, some of them already at their minimum speed"""
FANS_KEEP = "THESE FANS KEEP THE LAST COMMAND"
"""in what is said when fans could not be left at the commands that they should have"""
_POLL_S = 0.1
_SETTLED = 0.02  # of the whole change: so little changes any more
_FOLLOWS = 0.05  # of the top speed: a fan that changes less over the whole range does not follow its command
_NOISE_SIGMAS = 5.0  # a smaller change may be noise
_TOLERANCE = 0.02  # of the range: a device rounds its commands


def turning(tray: TrayConfig) -> tuple[float, float]:
    """The commands between which a tray is swept unless the user names others, lowest and highest: from a fifth of its
    range, at which most fans turn, since a fan that stops does not cool. A tray that turns its fans both ways is swept
    from command_min."""
    share = 0.0 if tray.command_min < 0.0 else LEAST_SHARE
    return tray.command_min + share * (tray.command_max - tray.command_min), tray.command_max


def range_in_words(tray: TrayConfig, lowest: float, highest: float) -> str:
    """Commands with their shares of the tray's range: a lowest one of 0.2 is next to nothing where they go to 255."""
    low, high = ((each - tray.command_min) / (tray.command_max - tray.command_min) for each in (lowest, highest))
    return f"commands from {lowest:g} to {highest:g}, {low:.0%} to {high:.0%} of its range"


def holds_s(slowest_s: float) -> tuple[float, float]:
    """How long a long step and a short one last. slowest_s: the longest time constant of the fans."""
    return min(max(SETTLING * slowest_s, SHORTEST_S), LONGEST_S), min(max(slowest_s, SHORTEST_S), LONGEST_S)


def duration_s(rounds: int, slowest_s: float) -> float:
    """How long a sweep takes, about."""
    long_s, short_s = holds_s(slowest_s)
    return PROBES * max(long_s, SHORTEST_PROBE_S) + rounds * (len(LEVELS) * long_s + len(SHORT_LEVELS) * short_s)


def levels_of(levels: Sequence[float], place: int) -> tuple[float, ...]:
    """The levels in the order of a fan, by its place among those that are moved: each begins one level further on.

    High and low levels alternate, so the load of the fans' supply hardly changes with the speed of any one of them.
    """
    first = place % len(levels)
    return (*levels[first:], *levels[:first])


class Observed(NamedTuple):
    """Samples since a moment. t_s: (n,), since that moment. command, speed_rad_s: (n, fans)."""

    t_s: Array
    command: Array
    speed_rad_s: Array


class TrayLine(Protocol):
    """The tray as an excitation sees it."""

    def send(self, values: Mapping[int, float]) -> None:
        """Send commands, by fan; returns when the device has them. Raises `UserError` if they cannot be sent."""
        ...

    def observed(self) -> Observed:
        """The samples since the last command."""
        ...

    def wait(self, seconds: float) -> bool:
        """Wait; returns whether the user wants to stop."""
        ...


class StoppedError(Exception):
    """The user wants to stop."""


@dataclass(frozen=True)
class Excitation:
    """One excitation of some fans of a tray, between two commands."""

    line: TrayLine
    fans: Sequence[int]
    low: float
    high: float
    rounds: int
    progress: Callable[[str], None]
    """is given a line for each step"""
    names: FanNames = NO_NAMES

    def run(self) -> dict[int, float]:
        """Move the commands; returns the time constant of each fan, s; NaN for one that does not follow its command.

        Raises:
            StoppedError: the user wants to stop.
            UserError: something else sets the commands, or a command cannot be sent.
        """
        time_constants_s = self._time_constants()
        slowest_s = np.nanmax([*time_constants_s.values(), SHORTEST_S / SETTLING])
        steps = list(self._steps(float(slowest_s)))
        left_s = sum(hold_s for _, hold_s in steps)
        self.progress(f"{len(steps)} steps, {left_s / 60.0:.1f} min")
        for number, (commands, hold_s) in enumerate(steps, 1):
            shown = f"{min(commands):g}" if len(set(commands)) == 1 else f"{min(commands):g} to {max(commands):g}"
            self.progress(f"step {number} of {len(steps)}: command {shown} for {hold_s:.1f} s, {left_s:.0f} s left")
            self.line.send(dict(zip(self.fans, commands, strict=True)))
            self._wait(hold_s)
            self._check_obeyed(np.array(commands))
            left_s -= hold_s
        return time_constants_s

    def _steps(self, slowest_s: float) -> Iterator[tuple[list[float], float]]:
        """Commands of the fans and duration, s, of each step."""
        long_s, short_s = holds_s(slowest_s)
        for number in range(self.rounds):
            order = -1 if number % 2 else 1
            for levels, hold_s in ((LEVELS, long_s), (SHORT_LEVELS, short_s)):
                of_each_fan = (levels_of(levels[::order], place) for place in range(len(self.fans)))
                for of_fans in zip(*of_each_fan, strict=True):
                    yield [self.low + level * (self.high - self.low) for level in of_fans], hold_s

    def _time_constants(self) -> dict[int, float]:
        """The longer one of each fan, of a step up and one down over the whole range."""
        found = np.full((2, len(self.fans)), np.nan)
        self._settle(self.low, "to the lowest command")
        self._say_which_read_0()
        for row, (command, words) in enumerate(((self.high, "up"), (self.low, "down"))):
            found[row] = self._settle(command, f"{words}, to see how fast readings follow")
        slowest_s = np.where(np.isfinite(found), found, -np.inf).max(axis=0)
        constants = {fan: float(s) if s >= 0 else np.nan for fan, s in zip(self.fans, slowest_s, strict=True)}
        for fan, seconds in constants.items():
            shown = f"its readings show 63 % of a change after {seconds:.2g} s"
            follows = shown if np.isfinite(seconds) else "does not follow its command"
            self.progress(f"{self.names.label(fan)}: {follows}")
        if not np.isfinite(slowest_s).any():
            raise UserError(
                f"no fan follows its command from {self.low:g} to {self.high:g}: do the fans have power and a tacho?"
            )
        return constants

    def _say_which_read_0(self) -> None:
        """Report the fans without speed at the lowest command, unless it is one that stops them."""
        speeds = self.line.observed().speed_rad_s[:, self.fans]
        for fan, speed_rad_s in zip(self.fans, speeds[-1] if len(speeds) else (), strict=False):
            if speed_rad_s == 0.0 and self.low > 0.0:
                self.progress(
                    f"{self.names.label(fan)} reads 0 at command {self.low:g}; if it stands still, give a higher --low"
                )

    def _settle(self, command: float, words: str) -> Array:
        """Send a command and wait until all speeds have settled. Returns the time constants, (fans,)."""
        self.progress(f"command {command:g}: {words}")
        self.line.send(dict.fromkeys(self.fans, command))
        waited_s = 0.0
        while waited_s < LONGEST_S:
            self._wait(_POLL_S)
            waited_s += _POLL_S
            seen = self.line.observed()
            speeds = seen.speed_rad_s[:, self.fans]
            slowest_s = max([s for s in time_constants(seen.t_s, speeds) if np.isfinite(s)], default=0.0)
            # Readings that a device holds look settled long before the fan has.
            if waited_s >= max(SHORTEST_PROBE_S, PROBED * slowest_s) and has_settled(seen.t_s, speeds):
                break
        self._check_obeyed(np.full(len(self.fans), command))
        seen = self.line.observed()
        return time_constants(seen.t_s, seen.speed_rad_s[:, self.fans])

    def _wait(self, seconds: float) -> None:
        if self.line.wait(seconds):
            raise StoppedError

    def _check_obeyed(self, commands: Array) -> None:
        applied = self.line.observed().command
        if not len(applied):
            raise UserError("no sample arrives any more: see acquisition in `fantwin status`")
        wrong = np.abs(applied[-1, self.fans] - commands) > _TOLERANCE * (self.high - self.low)
        if wrong.any():
            place = int(np.argmax(wrong))
            fan = self.fans[place]
            raise UserError(
                f"{self.names.label(fan)} has command {applied[-1, fan]:g} and not {commands[place]:g}: something else "
                "sets it, its own controller or a program; stop that, or let it move the fans instead of a sweep"
            )


def has_settled(t_s: Array, speed_rad_s: Array) -> bool:
    """Whether the speeds (n, fans) of the time since a step (n,) have stopped changing, beside noise."""
    if len(t_s) < SETTLING:
        return False
    thirds = [(t_s >= t_s[-1] * share) & (t_s < t_s[-1] * (share + 1 / 6) + 1e-9) for share in (4 / 6, 5 / 6)]
    if not all(rows.any() for rows in thirds):
        return False
    before, after = (_mean(speed_rad_s[rows]) for rows in thirds)
    noise = _std(speed_rad_s[thirds[1]])
    largest = np.maximum(np.abs(after - _first(speed_rad_s)), _FOLLOWS * np.abs(after))
    return bool(np.all((np.abs(after - before) <= _SETTLED * largest + noise / 2) | ~np.isfinite(after)))


def time_constants(t_s: Array, speed_rad_s: Array) -> Array:
    """When each fan (fans,) has made 63 % of its change, s; NaN where the speed hardly changes or is not known."""
    if len(t_s) < SETTLING:
        return np.full(speed_rad_s.shape[1], np.nan)
    settled = speed_rad_s[-max(1, len(t_s) // 6) :]
    first, last = _first(speed_rad_s), _mean(settled)
    change, noise = last - first, _std(settled)
    follows = np.abs(change) > np.maximum(_FOLLOWS * np.maximum(np.abs(first), np.abs(last)), _NOISE_SIGMAS * noise)
    made = np.abs(speed_rad_s - first) >= (1 - np.exp(-1)) * np.abs(change)
    return np.where(follows, t_s[np.argmax(made, axis=0)], np.nan)


def _mean(speed_rad_s: Array) -> Array:
    known = np.isfinite(speed_rad_s)
    return np.where(known, speed_rad_s, 0.0).sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan)


def _first(speed_rad_s: Array) -> Array:
    """(fans,) the first reading of each fan; NaN where there is none."""
    return speed_rad_s[np.argmax(np.isfinite(speed_rad_s), axis=0), np.arange(speed_rad_s.shape[1])]


def _std(speed_rad_s: Array) -> Array:
    """(fans,) standard deviation of the readings of each fan; NaN where there is none."""
    return np.sqrt(_mean(np.square(speed_rad_s - _mean(speed_rad_s))))
