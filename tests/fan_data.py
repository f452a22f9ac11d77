"""Small simulated fans for the tests of the model maker. Units: seconds, rad/s, command of order one hundred."""

from collections.abc import Callable

import numpy as np

from twin import physics
from twin.integration import step_through
from twin.runs import Array, Run

PUBLISHED_PARAMETERS = np.array([0.15, 0.012, 0.0025])
PUBLISHED = np.array([[*PUBLISHED_PARAMETERS, 0.0]])
"""the same in the order of physics.PARAMETER_NAMES, for one fan"""
NOISE_RAD_S = np.sqrt(10.0)
RATE_HZ = 100.0


def random_stairs(rng: np.random.Generator, samples: int, fans: int, low: float = 0.0, high: float = 100.0) -> Array:
    """(samples, fans) command that jumps to a random level every 0.5 to 2 s, each fan on its own."""
    command = np.empty((samples, fans))
    for fan in range(fans):
        holds = rng.integers(50, 200, size=samples // 50 + 1)
        levels = rng.uniform(low, high, size=len(holds))
        command[:, fan] = np.repeat(levels, holds)[:samples]
    return command


def simulate(
    acceleration: Callable[[Array, Array], Array],
    command: Array,
    rng: np.random.Generator,
    *,
    noise_rad_s: float = NOISE_RAD_S,
    name: str = "simulated",
    substeps: int = 10,
) -> Run:
    """A fan run sampled at 100 Hz, integrated with substeps per sample, noise added to the speed."""
    samples, fans = command.shape
    fine_command = np.repeat(command, substeps, axis=0)
    fine_step_s = np.full(len(fine_command), 1.0 / (RATE_HZ * substeps))
    speed, _ = step_through(acceleration, np.zeros(fans), fine_command, fine_step_s)
    noisy = speed[::substeps] + rng.normal(0.0, noise_rad_s, size=(samples, fans))
    return Run(name, np.arange(samples) / RATE_HZ, command, noisy)


def published_run(seed: int, duration_s: float = 40.0, fans: int = 1) -> Run:
    """The published simulated fan: exact physics, noise variance 10."""
    rng = np.random.default_rng(seed)
    parameters = np.tile(PUBLISHED, (fans, 1))
    command = random_stairs(rng, round(duration_s * RATE_HZ), fans)
    return simulate(lambda speed, u: physics.acceleration(speed, u, parameters), command, rng, name=f"published {seed}")


def rough_run(seed: int, duration_s: float = 40.0, fans: int = 1, spread: float = 0.1, low: float = 0.0) -> Run:
    """Fans with a dead zone in the drive and Stribeck friction, whose physics differ by spread, from fan to fan."""
    rng = np.random.default_rng(seed)
    scatter = 1.0 + spread * np.linspace(-1.0, 1.0, fans)[:, np.newaxis] if fans > 1 else np.ones((1, 1))
    parameters = PUBLISHED * scatter

    def acceleration(speed: Array, command: Array) -> Array:
        effective = np.maximum(command - 8.0, 0.0)
        friction = (4.0 + 8.0 * np.exp(-((speed / 25.0) ** 2))) * np.tanh(speed / 3.0)
        return physics.acceleration(speed, effective - friction, parameters)

    command = random_stairs(rng, round(duration_s * RATE_HZ), fans, low)
    return simulate(acceleration, command, rng, name=f"rough {seed}")
