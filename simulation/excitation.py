"""Command profiles over time, for fans without commands from a host.

A profile is a function of time, `command(t_s) -> (fans,)`, within `low..high`. Each fan has its own; the same seed
gives the same commands. Profiles are periodic; those made of steps, and the thermostat, jump where a period begins
again.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from copy import copy
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fantwin.simulation.errors import SimulationError

Array: TypeAlias = NDArray[np.float64]

UPDATES_HZ = 10.0
STEPS = 255
ZONE_C = (26.5, 33.0, 38.0, 42.0, 47.0, 52.0, 58.0, 66.0)
"""settled temperatures of a zone; the first stops the fans"""
NEIGHBOUR_C = 1.5
"""the second fan of a zone is so much warmer"""
JUMP_AFTER_S = (15.0, 600.0)
"""a zone keeps its load so long, equally often at each order of magnitude"""
LAG_S = 5.0
NOISE_C = 0.2
"""standard deviation of the wandering of a temperature"""
STOP_C, START_C, FULL_C = 29.0, 31.0, 65.0


class Thermostat:
    """Commands as cooling controllers give them: temperature wanders, jumps, and fans stop and start.

    Two neighbouring fans share a zone, whose load jumps between cold, where the fans stop, and hot. The temperature of
    each fan follows its zone with a lag; below `STOP_C` the fan is switched off, above `START_C` on again, and between
    them it keeps its state. The duty rises with the temperature from low to high, in steps of 1/255 as the registers of
    PWM controllers have it, ten times a second. After a time, the commands begin again.
    """

    def __init__(self, fans: int, seed: int, low: float, high: float, period_s: float = 3600.0) -> None:
        """Draw the commands. low, high: duty of a running fan, 0 to 1; a stopped one has 0."""
        samples = round(period_s * UPDATES_HZ)
        zones = np.random.default_rng(seed).spawn((fans + 1) // 2)
        self._steps = np.empty((samples, fans), np.uint8)  # a day of hundreds of fans
        for first, zone in zip(range(0, fans, 2), zones, strict=True):
            zone_c = _zone_c(zone, samples)
            for fan in range(first, min(first + 2, fans)):
                temperature_c = _lagged(zone, zone_c + NEIGHBOUR_C * (fan - first))
                share = np.clip((temperature_c - START_C) / (FULL_C - START_C), 0.0, 1.0)
                duty = np.where(_is_on(temperature_c), low + (high - low) * share, 0.0)
                self._steps[:, fan] = np.round(duty * STEPS)

    def command(self, t_s: float) -> Array:
        """(fans,) duty in force at t_s."""
        return self._steps[int(t_s * UPDATES_HZ + 1e-6) % len(self._steps)] / STEPS

    def side_by_side(self, starts_s: Sequence[float], seconds: float) -> Thermostat:
        """A thermostat of as many times the fans, which have the commands from each of these times on, for a time."""
        found = copy(self)
        numbers = np.arange(round(seconds * UPDATES_HZ))
        parts = [self._steps[(round(start_s * UPDATES_HZ) + numbers) % len(self._steps)] for start_s in starts_s]
        found._steps = np.concatenate(parts, axis=1)
        return found

    def is_on(self, times_s: Array, fan: int) -> NDArray[np.bool_]:
        """Whether a fan has a duty at times; same shape."""
        return self._steps[(times_s * UPDATES_HZ + 1e-6).astype(np.int64) % len(self._steps), fan] > 0


def _zone_c(rng: np.random.Generator, samples: int) -> Array:
    """(samples,) settled temperature of a zone: levels, each held for a while; warm at first."""
    shortest, longest = (hold_s * UPDATES_HZ for hold_s in JUMP_AFTER_S)
    holds = np.exp(rng.uniform(np.log(shortest), np.log(longest), size=int(samples / shortest) + 1))
    levels = rng.integers(len(ZONE_C) - 1, size=len(holds)).cumsum() + np.arange(
        1, len(holds) + 1
    )  # never the same twice
    return np.repeat(np.array(ZONE_C)[levels % len(ZONE_C)], np.round(holds).astype(np.int64))[:samples]


def _lagged(rng: np.random.Generator, settled_c: Array) -> Array:
    """(samples,) temperature that follows the settled one, and wanders."""
    from scipy.signal import lfilter  # noqa: PLC0415  slow to import, and the other profiles do without

    kept = np.exp(-1.0 / (UPDATES_HZ * LAG_S))
    noise_c = NOISE_C * np.sqrt(1.0 - kept * kept) * rng.normal(size=len(settled_c))
    filtered, _ = lfilter([1.0], [1.0, -kept], (1.0 - kept) * settled_c + noise_c, zi=[kept * settled_c[0]])
    return filtered


def _is_on(temperature_c: Array) -> NDArray[np.bool_]:
    """(samples,) whether the fan is switched on: at first it is, between the two limits it stays as it was."""
    decided = (temperature_c < STOP_C) | (temperature_c > START_C)
    latest = np.maximum.accumulate(np.where(decided, np.arange(len(decided)), -1))
    return np.where(latest >= 0, temperature_c[np.maximum(latest, 0)] > START_C, True)


class Excitation(Protocol):
    """A profile of commands."""

    def command(self, t_s: float) -> Array:
        """(fans,) commands in force at t_s >= 0."""
        ...


class Staircase:
    """Up in equal steps and down again, each step held; each fan starts at a step of its own."""

    def __init__(self, fans: int, seed: int, low: float, high: float, steps: int = 8, hold_s: float = 4.0) -> None:
        climb = np.linspace(low, high, steps + 1)
        self._levels = np.concatenate((climb, climb[-2:0:-1]))
        self._hold_s = hold_s
        self._shift = np.random.default_rng(seed).integers(len(self._levels), size=fans)

    def command(self, t_s: float) -> Array:
        """(fans,) levels in force at t_s."""
        return self._levels[(int(t_s / self._hold_s) + self._shift) % len(self._levels)]


class Prbs:
    """Pseudo-random binary sequence: a maximum-length shift register x^10 + x^7 + 1 chooses between two levels."""

    def __init__(self, fans: int, seed: int, low: float, high: float, bit_s: float = 0.5) -> None:
        register = [1] * 10
        bits = []
        for _ in range(2**10 - 1):
            bits.append(register[-1])
            register = [register[9] ^ register[6], *register[:-1]]
        self._levels = np.where(np.array(bits) == 1, high, low)
        self._bit_s = bit_s
        self._shift = np.random.default_rng(seed).integers(len(bits), size=fans)

    def command(self, t_s: float) -> Array:
        """(fans,) levels in force at t_s."""
        return self._levels[(int(t_s / self._bit_s) + self._shift) % len(self._levels)]


class Multisine:
    """Sines of equal amplitude and random phase on harmonics of one period, about equally spaced in log frequency."""

    HARMONICS = np.array([1, 2, 3, 5, 8, 13, 21, 34, 55, 89])

    def __init__(self, fans: int, seed: int, low: float, high: float, period_s: float = 50.0) -> None:
        self._omega_rad_s = 2.0 * np.pi * self.HARMONICS / period_s
        self._phase_rad = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, size=(fans, len(self.HARMONICS)))
        self._low, self._high = low, high
        samples_s = np.linspace(0.0, period_s, 40 * int(self.HARMONICS[-1]))
        waves = np.stack([self._wave(t_s) for t_s in samples_s])
        self._minimum, self._maximum = waves.min(axis=0), waves.max(axis=0)

    def command(self, t_s: float) -> Array:
        """(fans,) commands at t_s; the extremes over a period are low and high."""
        share = (self._wave(t_s) - self._minimum) / (self._maximum - self._minimum)
        return self._low + (self._high - self._low) * np.clip(share, 0.0, 1.0)

    def _wave(self, t_s: float) -> Array:
        return np.sin(self._omega_rad_s * t_s + self._phase_rad).sum(axis=1)


class Chirp:
    """A sine whose frequency rises exponentially from first_hz to last_hz, then falls back the same way."""

    def __init__(
        self,
        fans: int,
        seed: int,
        low: float,
        high: float,
        first_hz: float = 0.02,
        last_hz: float = 2.0,
        sweep_s: float = 60.0,
    ) -> None:
        self._rate = np.log(last_hz / first_hz) / sweep_s
        self._first_hz, self._sweep_s = first_hz, sweep_s
        self._centre, self._amplitude = (low + high) / 2.0, (high - low) / 2.0
        self._phase_rad = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, size=fans)

    def command(self, t_s: float) -> Array:
        """(fans,) commands at t_s."""
        sweeps, into_s = divmod(t_s, 2.0 * self._sweep_s)
        sweep_cycles = self._cycles(self._sweep_s)
        falling_s = into_s - self._sweep_s
        # On the way down the sweep runs backwards: the remaining cycles are subtracted from the total.
        cycles = (
            self._cycles(into_s) if falling_s < 0.0 else 2.0 * sweep_cycles - self._cycles(self._sweep_s - falling_s)
        )
        turn_rad = 2.0 * np.pi * (2.0 * sweep_cycles * sweeps + cycles)
        return self._centre + self._amplitude * np.sin(turn_rad + self._phase_rad)

    def _cycles(self, into_s: float) -> float:
        return self._first_hz * (np.exp(self._rate * into_s) - 1.0) / self._rate


class Manual:
    """A person turning a knob per fan: slow turns to random levels, with pauses between them."""

    def __init__(
        self,
        fans: int,
        seed: int,
        low: float,
        high: float,
        period_s: float = 3600.0,
        turn_s: tuple[float, float] = (0.5, 3.0),
        hold_s: tuple[float, float] = (1.0, 6.0),
    ) -> None:
        self._period_s = period_s
        # The profiles of all fans follow one another on one time axis, so that one interpolation serves them all.
        self._offset_s = np.arange(fans) * period_s
        times, levels = [], []
        for offset_s, rng in zip(self._offset_s, np.random.default_rng(seed).spawn(fans), strict=True):
            knob_s, knob = _knob(rng, low, high, period_s, turn_s, hold_s)
            times.append(offset_s + knob_s)
            levels.append(knob)
        self._times_s, self._levels = np.concatenate(times), np.concatenate(levels)

    def command(self, t_s: float) -> Array:
        """(fans,) commands at t_s."""
        return np.interp(t_s % self._period_s + self._offset_s, self._times_s, self._levels)


def _knob(
    rng: np.random.Generator,
    low: float,
    high: float,
    period_s: float,
    turn_s: tuple[float, float],
    hold_s: tuple[float, float],
) -> tuple[Array, Array]:
    """Breakpoints of one profile: times (n,) from 0 to below period_s, and levels (n,).

    The last level is the first one, so that the next period continues without a jump.
    """
    turns = int(period_s / (turn_s[0] + hold_s[0])) + 1
    durations_s = np.stack((rng.uniform(*hold_s, size=turns), rng.uniform(*turn_s, size=turns)), axis=1)
    corners_s = np.concatenate(([0.0], np.cumsum(durations_s)))
    levels = np.repeat(rng.uniform(low, high, size=turns + 1), 2)[: len(corners_s)]
    # Only turns that leave time for the last one, which goes back to the first level.
    count = 2 * int(np.searchsorted(corners_s[::2], period_s - turn_s[1])) - 1
    last_s = np.nextafter(period_s, 0.0)
    return np.append(corners_s[:count], last_s), np.append(levels[:count], levels[0])


PROFILES: dict[str, Callable[[int, int, float, float], Excitation]] = {
    "staircase": Staircase,
    "prbs": Prbs,
    "multisine": Multisine,
    "chirp": Chirp,
    "manual": Manual,
    "thermostat": Thermostat,
}
LOW, HIGH = 0.1, 0.95


def excitation(profile: str, fans: int, seed: int, low: float = LOW, high: float = HIGH) -> Excitation:
    """The profile called `profile`.

    Raises:
        SimulationError: no such profile, or low is not below high.
    """
    if profile not in PROFILES:
        close = difflib.get_close_matches(profile, PROFILES, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(PROFILES)}"
        raise SimulationError(f"unknown profile {profile!r}; {hint}")
    if not low < high:
        raise SimulationError(f"commands from {low:g} to {high:g}: the first must be smaller")
    return PROFILES[profile](fans, seed, low, high)
