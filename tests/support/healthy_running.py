"""Healthy running of fans with known variation, as predictions: a new run for each seed, without a twin's file."""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import lfilter

from fantwin.schemas.messages import Array, Prediction
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.model.operation import Fans
from tests.support.made_messages import filled
from tests.support.scored_blocks import model_fans

RATE_HZ = 10
TOP_RAD_S = 300.0
NOISE_RAD_S = 0.5
WANDER_S, AIR_S = 2.0, 3600.0
FIRST_T_NS = 1_790_000_000 * NS_PER_S


def made_fans(count: int) -> Fans:
    """Fans whose command is a torque, with exact tachos."""
    return model_fans(
        count,
        top_rad_s=TOP_RAD_S,
        inertia=0.2,
        viscous=0.05,
        drag=0.0005,
        noise_rad_s=NOISE_RAD_S,
        coasts_s=3.0,
        balance_noise=1.0,
        balance_filter_per_s=20.0,
    )


def running(
    fans: int, seconds: float, seed: int, mean: float = 0.0, air: float = 0.005, wander: float = 0.001
) -> Prediction:
    """Fans at half and at all of their top speed in turn, ten minutes each.

    mean, air, wander: standard deviations of what makes a fan differ from its twin, shares of its speed: for the whole
    run, over an hour, and over seconds.
    """
    rng = np.random.default_rng(seed)
    samples = round(seconds * RATE_HZ)
    share = rng.normal(0.0, mean, fans) + sum(
        _ornstein_uhlenbeck(rng, (samples, fans), std, time_s) for std, time_s in ((air, AIR_S), (wander, WANDER_S))
    )
    step = np.arange(samples) // (600 * RATE_HZ) % 2
    predicted = np.repeat(TOP_RAD_S * (0.5 + 0.5 * step)[:, np.newaxis], fans, axis=1)
    measured = predicted * (1.0 + share) + rng.normal(0.0, NOISE_RAD_S, (samples, fans))
    return filled(
        Prediction,
        samples,
        fans,
        period_ns=NS_PER_S // RATE_HZ,
        t_ns=FIRST_T_NS + np.arange(samples) * (NS_PER_S // RATE_HZ),
        command=predicted / 3.0,
        measured_speed_rad_s=measured,
        predicted_speed_rad_s=predicted,
        sigma_rad_s=NOISE_RAD_S,
        torque_balance_command=np.nan,
        torque_balance_sigma_command=1.0,
    )


def _ornstein_uhlenbeck(rng: np.random.Generator, shape: tuple[int, int], std: float, time_s: float) -> Array:
    kept = math.exp(-1.0 / (RATE_HZ * time_s))
    noise = rng.normal(0.0, std, shape)
    noise[1:] *= math.sqrt(1.0 - kept**2)
    return np.asarray(lfilter([1.0], [1.0, -kept], noise, axis=0))
