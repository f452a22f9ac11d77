"""The simulated fans of bench.training.published_fan as most tests want them: what was measured, under stairs from 0 to
100."""

import numpy as np

from bench.training import published_fan
from bench.training.published_fan import DRAG, INERTIA, NOISE_RAD_S, RATE_HZ, ROUGH_RANGE, VISCOUS
from fantwin.schemas.tacho import Tacho
from fantwin.twin.fitting.balance_fit import balance_of, filtered_terms
from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.runs import Array, Run

__all__ = [
    "NOISE_RAD_S",
    "PUBLISHED_PARAMETERS",
    "RATE_HZ",
    "counted_run",
    "parameters_of",
    "published_parameters",
    "published_run",
    "rough_run",
    "stairs",
    "torque_balance",
]

PUBLISHED_PARAMETERS = np.array([INERTIA, VISCOUS, DRAG])


def parameters_of(fans: int = 1, /, **values: float) -> Array:
    """(fans, 4) parameters of equal fans; 0 for those that are not given."""
    return np.tile([values.get(name, 0.0) for name in PARAMETER_NAMES], (fans, 1))


def published_parameters(fans: int = 1, /, **others: float) -> Array:
    """(fans, 4) those of the published fan, but for some."""
    return parameters_of(fans, **{"J": INERTIA, "alpha": VISCOUS, "C_D": DRAG} | others)


def stairs(
    rng: np.random.Generator, samples: int, fans: int, low: float = ROUGH_RANGE[0], high: float = ROUGH_RANGE[1]
) -> Array:
    """(samples, fans) command that jumps to a random level every 0.5 to 2 s, each fan on its own."""
    return published_fan.stairs(rng, samples, fans, low, high)


def published_run(seed: int, duration_s: float = 40.0, fans: int = 1) -> Run:
    """The published simulated fan: exact physics, noise variance 10."""
    command = published_fan.random_stairs(seed, duration_s, fans, *ROUGH_RANGE)
    return published_fan.published_fan(command, seed, f"published {seed}").run


def rough_run(
    seed: int, duration_s: float = 40.0, fans: int = 1, low: float = ROUGH_RANGE[0], high: float = ROUGH_RANGE[1]
) -> Run:
    """Fans with a dead zone in the drive and Stribeck friction, whose physics differ by 10 % from fan to fan."""
    return published_fan.rough_run(seed, duration_s, fans, low=low, high=high).run


def counted_run(seed: int, tacho: Tacho, duration_s: float = 120.0, rate_hz: float = 10.0) -> Run:
    """The published fan, measured by a counting tacho whose windows begin at a random time, without other noise.

    Its commands change with the samples only.
    """
    held = round(RATE_HZ / rate_hz)
    command = np.repeat(
        stairs(np.random.default_rng(seed), round(duration_s * rate_hz), 1, *published_fan.TEST_RANGE), held, axis=0
    )
    speed_rad_s = published_fan.published_fan(command, seed, "counted").true_speed_rad_s[:, 0]
    t_s = np.arange(len(speed_rad_s)) / RATE_HZ
    turned = np.concatenate(([0.0], np.cumsum((speed_rad_s[1:] + speed_rad_s[:-1]) / (2.0 * RATE_HZ))))
    first_s, phase = np.random.default_rng([seed, 2]).uniform(size=2)
    ends_s = tacho.held_s * (first_s + np.arange(np.ceil(duration_s / tacho.held_s)))

    def pulses_until(at_s: Array) -> Array:
        return np.floor(phase + np.interp(at_s, t_s, turned) * tacho.pulses / (2.0 * np.pi))

    counts = pulses_until(ends_s) - pulses_until(ends_s - tacho.window_s)
    sampled = t_s[::held]
    latest = np.searchsorted(ends_s, sampled - tacho.delay_s, side="right") - 1
    readings = np.where(latest >= 0, counts[latest] * tacho.resolution_rad_s, np.nan)
    return Run(f"counted {seed}", sampled, command[::held], readings, (tacho,))


def torque_balance(command: Array, speed_rad_s: Array, period_s: float, coefficients: Array, lag_s: Array) -> Array:
    """(n, fans) balance by coefficients (fans, 4), see twin.fitting.balance_fit."""
    return balance_of(filtered_terms(command, speed_rad_s, period_s, lag_s)[0], coefficients)
