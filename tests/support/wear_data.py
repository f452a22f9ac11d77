"""Fans that change over weeks, as the slow state of a filter shows them, and what `scoring.wear` makes of that."""

from __future__ import annotations

import json
import math
from dataclasses import asdict

import numpy as np

from fantwin.schemas.header import Header
from fantwin.schemas.messages import Array, ScorerSnapshot
from fantwin.scoring.wear.trend import NS_PER_DAY
from fantwin.scoring.wear.wear_monitor import WearMonitor

EVERY_S = 1800.0
PER_DAY = 48
LOSS, DAYS_OF_WEAR = 0.05, 30
"""share of its speed that the worn fan loses in these days"""
START_NS = 1_772_323_200 * 10**9
TWIN, AGEING_PER_SQRT_H, AIR, AIR_H = 0.02, 0.002, 0.01, 1.0
"""priors of the model: standard deviation of the twin's error, of its walk and of the air; and how long air stays"""
NOISE = 0.002
"""standard deviation of the mean speed over EVERY_S, share of the speed"""


def times_ns(days: float, start_ns: int = START_NS) -> Array:
    """(n,) one every EVERY_S."""
    return start_ns + np.arange(1, round(days * PER_DAY) + 1) * round(EVERY_S * 1e9)


def slow_states(change: Array, seed: int = 1) -> tuple[Array, Array]:
    """What a Kalman filter of twin error and air says of the former: (n, fans) mean, (n,) standard deviation.

    change: (n, fans) true change of the speed, share of it, every EVERY_S. Each twin has an error of its own.
    """
    rng, fans = np.random.default_rng(seed), change.shape[1]
    hours = EVERY_S / 3600.0
    keep = np.array([1.0, math.exp(-hours / AIR_H)])
    added = np.array([AGEING_PER_SQRT_H**2 * hours, AIR**2 * (1.0 - keep[1] ** 2)])
    mean, covariance = np.zeros((fans, 2)), np.diag([TWIN**2, AIR**2])
    error, air = rng.normal(0.0, TWIN, fans), rng.normal(0.0, AIR, fans)
    shares, std_error = np.empty(change.shape), np.empty(len(change))
    for row, of_fans in enumerate(change):
        air = keep[1] * air + math.sqrt(added[1]) * rng.normal(size=fans)
        measured = error + of_fans + air + rng.normal(0.0, NOISE, fans)
        mean, covariance = mean * keep, covariance * np.outer(keep, keep) + np.diag(added)
        with_states = covariance.sum(axis=0)
        gain = with_states / (with_states.sum() + NOISE**2)
        mean = mean + np.outer(measured - mean.sum(axis=1), gain)
        covariance = covariance - np.outer(gain, with_states)
        shares[row], std_error[row] = mean[:, 0], math.sqrt(covariance[0, 0])
    return shares, std_error


def feed(monitor: WearMonitor, t_ns: Array, shares: Array, std_error: Array) -> None:
    """Give a monitor these slow states, (n, fans) and (n,), while all fans count."""
    for at_ns, share, error in zip(t_ns.tolist(), shares, std_error.tolist(), strict=True):
        errors = np.full(len(share), error)
        monitor.update(at_ns, np.ones(len(share), np.bool_), lambda share=share, errors=errors: (share, errors))


def loss_of(fan: int, fans: int, days: float) -> Array:
    """(n, fans) the change of a tray in which one fan loses LOSS in DAYS_OF_WEAR, and goes on so."""
    change = np.zeros((round(days * PER_DAY), fans))
    change[:, fan] = -LOSS * np.arange(1, len(change) + 1) / (DAYS_OF_WEAR * PER_DAY)
    return change


def worn_monitor(fans: int, worn_fan: int, days: float = DAYS_OF_WEAR, start_ns: int = START_NS) -> WearMonitor:
    """Monitor after these days of a tray with one fan that wears."""
    monitor = WearMonitor(fans, EVERY_S)
    feed(monitor, times_ns(days, start_ns), *slow_states(loss_of(worn_fan, fans, days)))
    return monitor


def worn_snapshot(tray: str, fans: int, worn_fan: int, t_ns: int, days: float = DAYS_OF_WEAR) -> ScorerSnapshot:
    """A scorer's snapshot with the wear of these days up to `t_ns`."""
    monitor = worn_monitor(fans, worn_fan, days, t_ns - round(days * NS_PER_DAY))
    state = json.dumps({"wear": asdict(monitor.state)})
    return ScorerSnapshot(header=Header("scorer", 0, tray), t_ns=t_ns, twin_sha256="", restored=False, state_json=state)
