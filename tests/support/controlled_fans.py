"""Simulated DC fans under the controllers of real ones, of known truth: the speed, a current limit, a temperature.

All fans of a kind are advanced together. Beside the noise of the tacho, the load of each fan and its supply wander, and
the drag of the air changes over hours, so that a controller has something to answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fantwin.simulation.plant import Disturbance, FanParameters, PlantState, advance, tray_of_fans
from fantwin.simulation.tacho import NoisyTacho
from fantwin.twin.runs import Run

Array = NDArray[np.float64]

PLAIN = FanParameters(coulomb_v=0.0, breakaway_v=0.0, duty_dead=0.0, duty_full=1.0)
"""fans that the physical model describes: J, alpha and C_D over the supply voltage are what is to be identified"""
LOAD_WANDER, LOAD_WANDER_S, SUPPLY_WANDER, SUPPLY_WANDER_S = 0.01, 3.0, 0.003, 20.0
BETWEEN_RUNS, OVER_HOURS, HOURS_S = 0.01, 0.007, 6 * 3600.0
"""wandering of the drag, as bench.detection.plant has them"""
TOP_RAD_S = 900.0


@dataclass(frozen=True)
class Fault:
    """Fault of some fans from start_s on. drag, supply: factors. brake_v: grows over grows_s, where that is not 0."""

    fans: Array
    start_s: float
    drag: float = 1.0
    supply: float = 1.0
    brake_v: float = 0.0
    grows_s: float = 0.0
    blocks: bool = False

    def on(self, t_s: float, disturbance: Disturbance) -> Disturbance:
        """The disturbance with this fault in it."""
        if t_s < self.start_s:
            return disturbance
        grown = min(1.0, (t_s - self.start_s) / self.grows_s) if self.grows_s else 1.0
        brake = 1e3 if self.blocks else self.brake_v * grown
        return Disturbance(
            np.where(self.fans, disturbance.drag_factor * self.drag, disturbance.drag_factor),
            np.where(self.fans, disturbance.brake_v + brake, disturbance.brake_v),
            np.where(self.fans, disturbance.supply_factor * self.supply, disturbance.supply_factor),
        )


class Controller:
    """Gives duty (fans,) at each sample; this one moves it from outside, in steps."""

    hold_s = (10.0, 120.0)

    def __init__(self, fans: int, rng: np.random.Generator, step_s: float) -> None:
        self.rng, self.step_s = rng, step_s
        self.until_s, self.wanted = np.zeros(fans), np.zeros(fans)

    def drawn(self, t_s: float, low: float, high: float) -> Array:
        """(fans,) a level of each, drawn again after it was held."""
        due = self.until_s <= t_s
        self.wanted = np.where(due, self.rng.uniform(low, high, len(due)), self.wanted)
        self.until_s = np.where(due, t_s + self.rng.uniform(*self.hold_s, len(due)), self.until_s)
        return self.wanted

    def duty(self, t_s: float, reading_rad_s: Array, speed_rad_s: Array) -> Array:
        """The duty by the reading, or by what the speed does to the rest of the world."""
        return self.drawn(t_s, 0.25, 0.95)


class OfSpeed(Controller):
    """PI of the reading, without wind-up. every_s: how often it answers; current: the limit of a drive, as the share of
    the torque of full duty by which a duty may exceed what the turning motor induces."""

    def __init__(
        self,
        fans: int,
        rng: np.random.Generator,
        step_s: float,
        *,
        gain: float = 4e-3,
        integral_per_s: float = 4e-3,
        rests: bool = False,
        current: float = math.inf,
    ) -> None:
        super().__init__(fans, rng, step_s)
        self.gain, self.integral_per_s, self.current = gain, integral_per_s, current
        self.integral = np.full(fans, 0.4)
        if rests:
            self.hold_s = (math.inf, math.inf)

    def drawn(self, t_s: float, low: float, high: float) -> Array:
        if math.isfinite(self.hold_s[0]):
            return super().drawn(t_s, low, high)
        return np.linspace(low + 0.2 * (high - low), high - 0.2 * (high - low), len(self.wanted))

    def duty(self, t_s: float, reading_rad_s: Array, speed_rad_s: Array) -> Array:
        error = self.drawn(t_s, 0.22 * TOP_RAD_S, 0.8 * TOP_RAD_S) - reading_rad_s
        proportional = self.gain * error
        wanted = proportional + self.integral + self.integral_per_s * self.step_s * error
        highest = np.minimum(1.0, self.current + 0.35 * reading_rad_s / TOP_RAD_S)
        duty = np.clip(wanted, 0.0, highest)
        self.integral = duty - proportional
        return duty


class OfTemperature(Controller):
    """PI of a temperature that the air flow lowers, once a second, in steps of 1/255. The heat load moves.

    steps: levels of duty with hysteresis instead.
    """

    AMBIENT_C, WANTED_C, HEAT_S = 25.0, 55.0, 60.0
    hold_s = (60.0, 600.0)

    def __init__(self, fans: int, rng: np.random.Generator, step_s: float, *, steps: bool = False) -> None:
        super().__init__(fans, rng, step_s)
        self.steps, self.level = steps, np.ones(fans, np.intp)
        self.temperature_c, self.integral, self.last = np.full(fans, 50.0), np.full(fans, 0.4), np.full(fans, 0.4)
        self.next_s = 0.0

    def duty(self, t_s: float, reading_rad_s: Array, speed_rad_s: Array) -> Array:
        watts = self.drawn(t_s, 60.0, 200.0)
        flow = np.maximum(speed_rad_s / TOP_RAD_S, 0.05) ** 0.8
        settled_c = self.AMBIENT_C + 0.12 * watts / flow
        self.temperature_c += (settled_c - self.temperature_c) * self.step_s / self.HEAT_S
        if t_s < self.next_s:
            return self.last
        self.next_s = t_s + 1.0 - 1e-6
        seen_c = np.round(self.temperature_c + 0.2 * self.rng.normal(size=len(watts)), 1)
        if self.steps:
            up = seen_c > np.array([48.0, 58.0, 68.0, np.inf])[self.level]
            down = seen_c < np.array([-np.inf, 40.0, 50.0, 60.0])[self.level]
            self.level = self.level + up - down
            self.last = np.array([0.3, 0.5, 0.7, 0.95])[self.level]
        else:
            error = seen_c - self.WANTED_C
            wanted = 0.02 * error + self.integral + 2e-4 * error
            duty = np.clip(wanted, 0.2, 1.0)
            self.integral = duty - 0.02 * error
            self.last = np.round(duty * 255) / 255
        return self.last


LOOPS: dict[str, Callable[[int, np.random.Generator, float], Controller]] = {
    "open": Controller,
    "PI fast": OfSpeed,
    "PI slow": lambda *of: OfSpeed(*of, gain=2e-4, integral_per_s=2e-4),
    "PI fast, rests": lambda *of: OfSpeed(*of, rests=True),
    "PI slow, rests": lambda *of: OfSpeed(*of, gain=2e-4, integral_per_s=2e-4, rests=True),
    "current limit": lambda *of: OfSpeed(*of, current=0.45),
    "temperature": OfTemperature,
    "hysteresis": lambda *of: OfTemperature(*of, steps=True),
}
ANSWER_THE_SPEED = ("PI fast", "PI slow", "PI fast, rests", "PI slow, rests", "current limit")


def plain_fans(fans: int, seed: int) -> FanParameters:
    """PLAIN fans that differ."""
    return tray_of_fans(fans, seed, base=PLAIN)


def true_parameters(parameters: FanParameters) -> Array:
    """(fans, 3) J, alpha and C_D of PLAIN fans, per unit of duty."""
    of = parameters
    return np.column_stack((of.J, of.alpha, of.C_D)) / np.asarray(of.gain * of.supply_v)[:, np.newaxis]


SUBSTEP_S = 1e-2
"""step of the motion; the current is exact"""
SETTLES_S = 60.0
"""time of the loop before the first sample"""


def samples(
    loops: Sequence[str],
    parameters: FanParameters,
    seconds: float,
    rate_hz: float,
    seed: int,
    *,
    faults: Sequence[Fault] = (),
    wander: float = 1.0,
    tacho: NoisyTacho | None = None,
    block: int = 512,
) -> Iterator[tuple[Array, Array]]:
    """Commands and readings (n, fans), block by block. The fans are as many under each loop, one loop after another."""
    fans, step_s = len(np.asarray(parameters.J)), 1.0 / rate_hz
    each = fans // len(loops)
    rng, load_rng, tacho_rng = map(np.random.default_rng, np.random.SeedSequence(seed).generate_state(3).tolist())
    controllers = [LOOPS[loop](each, rng, step_s) for loop in loops]
    of_loop = [slice(first, first + each) for first in range(0, fans, each)]
    tacho = tacho or NoisyTacho()
    state = PlantState(np.full(fans, 0.4 * TOP_RAD_S), np.full(fans, 4.0))
    load, supply = np.zeros(fans), np.zeros(fans)
    kept, kept_supply = math.exp(-step_s / LOAD_WANDER_S), math.exp(-step_s / SUPPLY_WANDER_S)
    air, phase = BETWEEN_RUNS * load_rng.normal(), load_rng.uniform(0.0, 2.0 * math.pi)
    commands, readings = [], []
    for k in range(round(-SETTLES_S * rate_hz), round(seconds * rate_hz)):
        t_s = k * step_s
        load = kept * load + math.sqrt(1.0 - kept**2) * LOAD_WANDER * load_rng.normal(size=fans)
        supply = kept_supply * supply + math.sqrt(1.0 - kept_supply**2) * SUPPLY_WANDER * load_rng.normal(size=fans)
        slow = air + OVER_HOURS * math.sin(2.0 * math.pi * t_s / HOURS_S + phase)
        disturbance = Disturbance(1.0 + wander * (load + slow), np.zeros(fans), 1.0 + wander * supply)
        for fault in faults:
            disturbance = fault.on(t_s, disturbance)
        reading, speed = tacho.read(state.speed_rad_s, tacho_rng), state.speed_rad_s
        duty = np.concatenate(
            [one.duty(t_s, reading[of], speed[of]) for one, of in zip(controllers, of_loop, strict=True)]
        )
        if k >= 0:
            commands.append(duty)
            readings.append(reading)
        state = advance(state, duty, step_s, parameters, disturbance, SUBSTEP_S)
        if len(commands) == block:
            yield np.array(commands), np.array(readings)
            commands, readings = [], []
    if commands:
        yield np.array(commands), np.array(readings)


def runs_of(
    loops: Sequence[str], parameters: FanParameters, seconds: float, rate_hz: float, seed: int, wander: float = 1.0
) -> dict[str, Run]:
    """The same as runs for the model maker, by loop; every loop has these fans."""
    many = tiled(parameters, len(loops))
    parts = zip(*samples(loops, many, seconds, rate_hz, seed, wander=wander), strict=True)
    commands, readings = map(np.concatenate, parts)
    t_s = np.arange(len(commands)) / rate_hz
    of_loop = (np.split(of, len(loops), axis=1) for of in (commands, readings))
    return {loop: Run(loop, t_s, *of) for loop, *of in zip(loops, *of_loop, strict=True)}


def run_with(loop: str, parameters: FanParameters, seconds: float, rate_hz: float, seed: int, *faults: Fault) -> Run:
    """A run under one loop, with faults."""
    parts = zip(*samples([loop], parameters, seconds, rate_hz, seed, faults=faults), strict=True)
    commands, readings = map(np.concatenate, parts)
    return Run(loop, np.arange(len(commands)) / rate_hz, commands, readings)


def tiled(parameters: FanParameters, times: int) -> FanParameters:
    """The same fans, repeated."""
    return FanParameters(**{name: np.tile(of, times) for name, of in vars(parameters).items()})
