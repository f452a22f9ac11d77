"""Command profiles over time, for fans without commands from a host.

A profile is a function of time, `command(t_s) -> (fans,)`, within `low..high`. Each fan has its own; the same seed
gives the same commands. Profiles are periodic; those made of steps, and the thermostat, jump where a period begins
again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fantwin.simulation.errors import SimulationError, nearest
from fantwin.simulation.plant import Array

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
BIT_S = 0.5
MULTISINE_S, MANUAL_S = 50.0, 3600.0
"""periods"""
FIRST_HZ, LAST_HZ, SWEEP_S = 0.02, 2.0, 60.0
TURN_S, PAUSE_S = (0.5, 3.0), (1.0, 6.0)
"""shortest and longest"""


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


class HeldLevels:
    """Levels in turn, each held; each fan starts at one of its own."""

    def __init__(self, levels: Array, hold_s: float, fans: int, seed: int) -> None:
        self._levels, self._hold_s = levels, hold_s
        self._shift = np.random.default_rng(seed).integers(len(levels), size=fans)

    def command(self, t_s: float) -> Array:
        """(fans,) levels in force at t_s."""
        return self._levels[(int(t_s / self._hold_s) + self._shift) % len(self._levels)]


class Staircase(HeldLevels):
    """Up in equal steps and down again, each step held."""

    def __init__(self, fans: int, seed: int, low: float, high: float, steps: int = 8, hold_s: float = 4.0) -> None:
        climb = np.linspace(low, high, steps + 1)
        super().__init__(np.concatenate((climb, climb[-2:0:-1])), hold_s, fans, seed)


class Prbs(HeldLevels):
    """Pseudo-random binary sequence: a maximum-length shift register x^10 + x^7 + 1 chooses between two levels."""

    def __init__(self, fans: int, seed: int, low: float, high: float) -> None:
        register = [1] * 10
        bits = []
        for _ in range(2**10 - 1):
            bits.append(register[-1])
            register = [register[9] ^ register[6], *register[:-1]]
        super().__init__(np.where(np.array(bits) == 1, high, low), BIT_S, fans, seed)


class Multisine:
    """Sines of equal amplitude and random phase on harmonics of one period, about equally spaced in log frequency."""

    HARMONICS = np.array([1, 2, 3, 5, 8, 13, 21, 34, 55, 89])

    def __init__(self, fans: int, seed: int, low: float, high: float) -> None:
        self._omega_rad_s = 2.0 * np.pi * self.HARMONICS / MULTISINE_S
        self._phase_rad = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, size=(fans, len(self.HARMONICS)))
        self._low, self._high = low, high
        samples_s = np.linspace(0.0, MULTISINE_S, 40 * int(self.HARMONICS[-1]))
        waves = np.stack([self._wave(t_s) for t_s in samples_s])
        self._minimum, self._maximum = waves.min(axis=0), waves.max(axis=0)

    def command(self, t_s: float) -> Array:
        """(fans,) commands at t_s; the extremes over a period are low and high."""
        share = (self._wave(t_s) - self._minimum) / (self._maximum - self._minimum)
        return self._low + (self._high - self._low) * np.clip(share, 0.0, 1.0)

    def _wave(self, t_s: float) -> Array:
        return np.sin(self._omega_rad_s * t_s + self._phase_rad).sum(axis=1)


class Chirp:
    """A sine whose frequency rises exponentially from `FIRST_HZ` to `LAST_HZ`, then falls back the same way."""

    def __init__(self, fans: int, seed: int, low: float, high: float) -> None:
        self._rate = np.log(LAST_HZ / FIRST_HZ) / SWEEP_S
        self._centre, self._amplitude = (low + high) / 2.0, (high - low) / 2.0
        self._phase_rad = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, size=fans)

    def command(self, t_s: float) -> Array:
        """(fans,) commands at t_s."""
        sweeps, into_s = divmod(t_s, 2.0 * SWEEP_S)
        sweep_cycles = self._cycles(SWEEP_S)
        falling_s = into_s - SWEEP_S
        # On the way down the sweep runs backwards: the remaining cycles are subtracted from the total.
        cycles = self._cycles(into_s) if falling_s < 0.0 else 2.0 * sweep_cycles - self._cycles(SWEEP_S - falling_s)
        turn_rad = 2.0 * np.pi * (2.0 * sweep_cycles * sweeps + cycles)
        return self._centre + self._amplitude * np.sin(turn_rad + self._phase_rad)

    def _cycles(self, into_s: float) -> float:
        return FIRST_HZ * (np.exp(self._rate * into_s) - 1.0) / self._rate


class Manual:
    """A person turning a knob per fan: slow turns to random levels, with pauses between them."""

    def __init__(self, fans: int, seed: int, low: float, high: float) -> None:
        # The profiles of all fans follow one another on one time axis, so that one interpolation serves them all.
        self._offset_s = np.arange(fans) * MANUAL_S
        knobs = [_knob(rng, low, high) for rng in np.random.default_rng(seed).spawn(fans)]
        offset_s = zip(self._offset_s, knobs, strict=True)
        self._times_s = np.concatenate([first_s + times_s for first_s, (times_s, _) in offset_s])
        self._levels = np.concatenate([levels for _, levels in knobs])

    def command(self, t_s: float) -> Array:
        """(fans,) commands at t_s."""
        return np.interp(t_s % MANUAL_S + self._offset_s, self._times_s, self._levels)


def _knob(rng: np.random.Generator, low: float, high: float) -> tuple[Array, Array]:
    """Breakpoints of one profile: times (n,) from 0 to below `MANUAL_S`, and levels (n,).

    The last level is the first one, so that the next period continues without a jump.
    """
    turns = int(MANUAL_S / (TURN_S[0] + PAUSE_S[0])) + 1
    durations_s = np.stack((rng.uniform(*PAUSE_S, size=turns), rng.uniform(*TURN_S, size=turns)), axis=1)
    corners_s = np.concatenate(([0.0], np.cumsum(durations_s)))
    levels = np.repeat(rng.uniform(low, high, size=turns + 1), 2)[: len(corners_s)]
    # Only turns that leave time for the last one, which goes back to the first level.
    count = 2 * int(np.searchsorted(corners_s[::2], MANUAL_S - TURN_S[1])) - 1
    last_s = np.nextafter(MANUAL_S, 0.0)
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
        raise SimulationError(f"unknown profile {profile!r}; {nearest(profile, PROFILES)}")
    if not low < high:
        raise SimulationError(f"commands from {low:g} to {high:g}: the first must be smaller")
    return PROFILES[profile](fans, seed, low, high)
