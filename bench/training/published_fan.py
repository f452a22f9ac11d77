"""Simulated fans with known ground truth: the published one, and a rough one that the physics do not describe.

The published fan is that of Peng and Chen, section 3: J w' + alpha w + C_D w|w| = tau with the parameters below,
RK4 at 0.5 ms, sampled at 10 ms, white measurement noise of variance 10. Its excitation is shown there in figures only
(5 and 6), so ours is chosen to fit the published tables: R2 0.9979 at an RMSE of 3.227 means a standard deviation of
70 rad/s of the training speeds, R2 0.9925 at 3.219 one of 37 rad/s of the test speeds, and maximum errors of 3.6 and
3.8 standard deviations are those of about 4000 samples, 40 s, of white noise. Training uses random stairs, the test a
sum of sines: another kind of command, within the training range.

The rough fan adds what the published physics leave out: a dead zone in the drive, Stribeck friction that falls with
speed, and, if wanted, a first-order electrical lag between command and torque.

Nothing here uses twin.models.physics or twin.models.integration: a test must not compare that code with itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fantwin.simulation.excitation import Multisine
from fantwin.twin.runs import Array, Run

INERTIA, VISCOUS, DRAG = 0.15, 0.012, 0.0025
NOISE_RAD_S = math.sqrt(10.0)
RATE_HZ = 100.0
SOLVER_STEP_S = 5e-4

TRAINING_RANGE = (0.0, 280.0)
TEST_RANGE = (20.0, 260.0)
ROUGH_RANGE = (0.0, 100.0)
STAIR_S = (0.5, 2.0)

DEAD_ZONE = 8.0
COULOMB, BREAKAWAY, STRIBECK_RAD_S, STANDSTILL_RAD_S = 4.0, 12.0, 25.0, 3.0

Torque: TypeAlias = Callable[[float, float], float]
"""(speed in rad/s, lagged command) to the torque that drives J w' + alpha w + C_D w|w|."""


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """A measured run and its true speeds."""

    run: Run
    true_speed_rad_s: Array
    """(n, fans), without noise"""

    @property
    def noise_rms_rad_s(self) -> float:
        """RMS of the noise in this run: the error of a perfect model."""
        return float(np.sqrt(np.mean((self.run.speed_rad_s - self.true_speed_rad_s) ** 2)))


def published_training(seed: int, duration_s: float = 40.0) -> SimulatedRun:
    """The published fan under random stairs; speeds with a standard deviation of about 70 rad/s."""
    return published_fan(random_stairs(seed, duration_s, 1, *TRAINING_RANGE), seed, f"published training {seed}")


def published_test(seed: int, duration_s: float = 40.0) -> SimulatedRun:
    """The published fan under a sum of sines; speeds with a standard deviation of about 37 rad/s."""
    return published_fan(sum_of_sines(seed, duration_s, 1, *TEST_RANGE), seed, f"published test {seed}")


def published_fan(command: Array, seed: int, name: str, *, lag_s: float = 0.0) -> SimulatedRun:
    """Identical fans under commands (n, fans) at 100 Hz, from standstill. seed: of the noise."""
    return _measured(command, [(_published_torque, INERTIA, VISCOUS, DRAG)] * command.shape[1], lag_s, seed, name)


def rough_run(
    seed: int,
    duration_s: float = 40.0,
    fans: int = 1,
    *,
    fan_variation: float = 0.1,
    lag_s: float = 0.0,
    low: float = ROUGH_RANGE[0],
    high: float = ROUGH_RANGE[1],
) -> SimulatedRun:
    """Rough fans under random stairs from `low` to `high`, whose parameters vary by +-fan_variation over the fans."""
    factors = 1.0 + fan_variation * np.linspace(-1.0, 1.0, fans) if fans > 1 else np.ones(1)
    parts = [(_rough_torque, INERTIA * s, VISCOUS * s, DRAG * s) for s in factors.tolist()]
    return _measured(random_stairs(seed, duration_s, fans, low, high), parts, lag_s, seed, f"rough {seed}")


def rough_fans(command: Array) -> Array:
    """(n, fans) speeds without noise of identical rough fans under commands (n, fans) at 100 Hz, from standstill."""
    return np.column_stack([_simulate(each.tolist(), _rough_torque, INERTIA, VISCOUS, DRAG, 0.0) for each in command.T])


def random_stairs(seed: int, duration_s: float, fans: int, low: float, high: float) -> Array:
    """(n, fans) commands at 100 Hz that jump to a random level every 0.5 to 2 s, independently for each fan."""
    return stairs(np.random.default_rng([seed, 0]), round(duration_s * RATE_HZ), fans, low, high)


def stairs(rng: np.random.Generator, samples: int, fans: int, low: float, high: float) -> Array:
    """As `random_stairs`, (samples, fans), drawn from rng."""
    shortest, longest = (round(hold_s * RATE_HZ) for hold_s in STAIR_S)
    command = np.empty((samples, fans))
    for fan in range(fans):
        holds = rng.integers(shortest, longest, size=samples // shortest + 1)
        command[:, fan] = np.repeat(rng.uniform(low, high, size=len(holds)), holds)[:samples]
    return command


def sum_of_sines(seed: int, duration_s: float, fans: int, low: float, high: float) -> Array:
    """(n, fans) commands at 100 Hz: ten sines of 0.02 to 1.8 Hz and random phase, from low to high."""
    profile = Multisine(fans, seed, low, high)
    return np.stack([profile.command(k / RATE_HZ) for k in range(round(duration_s * RATE_HZ))])


def _measured(
    command: Array, fans: list[tuple[Torque, float, float, float]], lag_s: float, seed: int, name: str
) -> SimulatedRun:
    true = np.column_stack([_simulate(command[:, k].tolist(), *fan, lag_s) for k, fan in enumerate(fans)])
    noise = np.random.default_rng([seed, 1]).normal(0.0, NOISE_RAD_S, size=true.shape)
    return SimulatedRun(Run(name, np.arange(len(true)) / RATE_HZ, command, true + noise), true)


def _published_torque(_speed_rad_s: float, command: float) -> float:
    return command


def _rough_torque(speed_rad_s: float, command: float) -> float:
    """Dead zone and friction; the friction is steep but smooth at standstill, so that RK4 keeps its order."""
    stribeck = (BREAKAWAY - COULOMB) * math.exp(-((speed_rad_s / STRIBECK_RAD_S) ** 2))
    return max(command - DEAD_ZONE, 0.0) - (COULOMB + stribeck) * math.tanh(speed_rad_s / STANDSTILL_RAD_S)


def _simulate(
    command: list[float], torque: Torque, inertia: float, viscous: float, drag: float, lag_s: float
) -> list[float]:
    """Speeds in rad/s at each sample, before its command acts. The lagged command is exact at the stages of RK4."""
    steps = round(1.0 / (RATE_HZ * SOLVER_STEP_S))
    h = SOLVER_STEP_S
    half_decay = math.exp(-0.5 * h / lag_s) if lag_s > 0.0 else 0.0

    def slope(w: float, u: float) -> float:
        return (torque(w, u) - (viscous + drag * abs(w)) * w) / inertia

    speeds, w, lagged = [], 0.0, command[0]
    for held in command:
        speeds.append(w)
        for _ in range(steps):
            now = lagged if lag_s > 0.0 else held
            middle = held + (now - held) * half_decay
            lagged = held + (middle - held) * half_decay
            k1 = slope(w, now)
            k2 = slope(w + 0.5 * h * k1, middle)
            k3 = slope(w + 0.5 * h * k2, middle)
            k4 = slope(w + h * k3, lagged)
            w += h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    return speeds
