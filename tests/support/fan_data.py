"""The simulated fans of simulation.published_fan as most tests want them: what was measured, under stairs from 0 to
100."""

import numpy as np

from simulation import published_fan
from simulation.published_fan import DRAG, INERTIA, NOISE_RAD_S, RATE_HZ, ROUGH_RANGE, VISCOUS
from twin.runs import Array, Run

__all__ = ["NOISE_RAD_S", "PUBLISHED_PARAMETERS", "RATE_HZ", "published_run", "rough_run", "stairs"]

PUBLISHED_PARAMETERS = np.array([INERTIA, VISCOUS, DRAG])


def stairs(
    rng: np.random.Generator, samples: int, fans: int, low: float = ROUGH_RANGE[0], high: float = ROUGH_RANGE[1]
) -> Array:
    """(samples, fans) command that jumps to a random level every 0.5 to 2 s, each fan on its own."""
    return published_fan.stairs(rng, samples, fans, low, high)


def published_run(seed: int, duration_s: float = 40.0, fans: int = 1) -> Run:
    """The published simulated fan: exact physics, noise variance 10."""
    command = published_fan.random_stairs(seed, duration_s, fans, *ROUGH_RANGE)
    return published_fan.published_fan(command, seed, f"published {seed}").run


def rough_run(seed: int, duration_s: float = 40.0, fans: int = 1, low: float = ROUGH_RANGE[0]) -> Run:
    """Fans with a dead zone in the drive and Stribeck friction, whose physics differ by 10 % from fan to fan."""
    return published_fan.rough_run(seed, duration_s, fans, low=low).run
