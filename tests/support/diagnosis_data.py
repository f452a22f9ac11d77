"""Windows of one simulated fan with known equation, noise, and fault with its time."""

import numpy as np

from scoring.diagnosis.regression_window import HealthyBalance, Window

STEP_S = 0.01
SUBSTEPS = 5
HEALTHY = HealthyBalance(
    inertia=0.0012,
    viscous=6e-4,
    drag=4.4e-7,
    friction=0.026,
    lag_s=0.0,
    covariance=np.zeros((4, 4)),
    filter_rate_per_s=3.0,
    sigma_command=0.0145,
    autocorrelation_time_s=0.005,
    lowest_speed_rad_s=40.0,
)
NOISE_RAD_S = 4.0
BEFORE_S, AFTER_S = 8.0, 8.0


def moving_command(seed: int, duration_s: float = BEFORE_S + AFTER_S) -> np.ndarray:
    """(n,) steps between 0.3 and 0.9, one each second."""
    levels = np.random.default_rng(seed).uniform(0.3, 0.9, int(np.ceil(duration_s)))
    return np.repeat(levels, round(1.0 / STEP_S))[: round(duration_s / STEP_S)]


def still_command(seed: int) -> np.ndarray:
    """(n,) constant."""
    return np.full(round((BEFORE_S + AFTER_S) / STEP_S), np.random.default_rng(seed).uniform(0.4, 0.8))


def onset_of(command: np.ndarray) -> int:
    """The sample with which faults begin."""
    return len(command) - round(AFTER_S / STEP_S)


def speeds(
    command: np.ndarray,
    drag: np.ndarray | float = 1.0,
    torque: np.ndarray | float = 0.0,
    gain: np.ndarray | float = 1.0,
) -> np.ndarray:
    """(n,) true speed. drag, gain: factors; torque: taken in units of the command; each a number or (n,)."""
    n = len(command)
    # Plain floats: in a loop they are several times faster than those of numpy.
    values = [np.broadcast_to(np.asarray(value, float), n).tolist() for value in (command, drag, torque, gain)]
    inputs = list(zip(*values, strict=True))
    speed, all_speeds = 0.0, []
    for _ in range(400):  # settles at the first command
        speed += STEP_S * _acceleration(HEALTHY, speed, *inputs[0])
    for at_sample in inputs:
        all_speeds.append(speed)
        for _ in range(SUBSTEPS):
            speed += STEP_S / SUBSTEPS * _acceleration(HEALTHY, speed, *at_sample)
    return np.array(all_speeds)


def _acceleration(fan: HealthyBalance, speed: float, command: float, drag: float, torque: float, gain: float) -> float:
    needed = fan.viscous * speed + drag * fan.drag * speed * abs(speed) + fan.friction + torque
    return (gain * command - needed) / fan.inertia


def measured(speed: np.ndarray, seed: int) -> np.ndarray:
    """(n,) with the noise of a tacho."""
    return speed + NOISE_RAD_S * np.random.default_rng(1000 + seed).normal(size=len(speed))


def from_onset(command: np.ndarray, faulty: float, healthy: float = 0.0) -> np.ndarray:
    """(n,) healthy before the onset and faulty after it."""
    return np.where(np.arange(len(command)) >= onset_of(command), faulty, healthy)


def window(command: np.ndarray, speed_rad_s: np.ndarray) -> Window:
    """A window with the onset where faults begin."""
    return Window(STEP_S, command, speed_rad_s, onset_of(command))
