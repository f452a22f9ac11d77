"""Streams of residuals of many fans for tests of scoring: first-order autoregressive, of a known correlation time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from schemas.enums import Statistic, Transition
from schemas.messages import Array
from schemas.units import NS_PER_S
from scoring.alarms.fan_condition import ConditionSettings
from scoring.alarms.tray_conditions import TrayConditions
from scoring.fan_scorer import FanScorer
from scoring.limits import Limits
from scoring.samples import Samples
from tests.support.score_alone import by_score, scores_alone

STEP_NS = 10_000_000
BLOCK = 512


def autoregressive(samples: int, fans: int, memory_s: float, seed: int, period_s: float = 0.01) -> Array:
    """(samples, fans) of variance one; memory_s 0: white."""
    noise = np.random.default_rng(seed).normal(size=(samples, fans))
    if not memory_s:
        return noise
    phi = math.exp(-period_s / memory_s)
    noise[1:] *= math.sqrt(1.0 - phi**2)
    made = lfilter([1.0], [1.0, -phi], noise, axis=0)
    return np.asarray(made)


def samples_of(speed: Array, balance: Array, first: int = 0, period_ns: int = STEP_NS) -> Samples:
    """Samples of two residuals, (n, fans) each, in sigma; NaN where they are not valid. The first is number `first`."""
    turning = 100.0 + 1e-6 * (np.arange(first, first + len(speed)) % 1000)
    return Samples(
        t_ns=(first + np.arange(len(speed), dtype=np.int64)) * period_ns,
        period_ns=period_ns,
        speed_rad_s=np.repeat(turning[:, np.newaxis], speed.shape[1], axis=1),
        speed_residual=speed,
        speed_valid=np.isfinite(speed),
        speed_sigma_rad_s=np.full(speed.shape, 1e4),  # so coarse that nothing counts as shared by the fans
        speed_unseen=np.zeros(speed.shape),
        balance=balance,
        balance_unseen=np.zeros(balance.shape),
        balance_sigma=np.full(speed.shape, 1e4),
        balance_valid=np.isfinite(balance),
        command=np.full(speed.shape, 50.0),
        predicted_rad_s=np.full(speed.shape, 100.0),
        missing=np.zeros(speed.shape, np.bool_),
        reading_missing=np.zeros(speed.shape, np.bool_),
        idle=np.zeros(speed.shape, np.bool_),
        alive=np.ones(speed.shape, np.bool_),
    )


def rows_of(samples: Samples, rows: slice) -> Samples:
    """Some rows of the samples."""
    return replace(samples, **{name: value[rows] for name, value in vars(samples).items() if name != "period_ns"})


def in_blocks(samples: Samples, block: int = BLOCK) -> Iterator[Samples]:
    """The samples, cut into blocks."""
    for first in range(0, len(samples.t_ns), block):
        yield rows_of(samples, slice(first, first + block))


@dataclass(frozen=True)
class Raised:
    """An alarm: fan, time and statistic."""

    fan: int
    t_s: float
    statistic: Statistic


def alarms_of(limits: Limits, blocks: Iterable[Samples], fans: int, scorer: FanScorer | None = None) -> list[Raised]:
    """Alarms that a scorer would raise, a new one unless it is given."""
    scorer = scorer or FanScorer(fans, limits)
    settings = ConditionSettings(round(limits.timing.on_delay_s * NS_PER_S), by_score(NS_PER_S))
    conditions = TrayConditions(fans, settings)
    raised: list[Raised] = []
    for block in blocks:
        scored = scorer.update(block)
        result = conditions.update(*scores_alone(block.t_ns, block.period_ns, scored.score))
        raised += [
            Raised(
                change.fan,
                int(block.t_ns[change.row]) / NS_PER_S,
                Statistic(int(scored.statistic[change.row, change.fan])),
            )
            for change in result.events
            if change.transition == Transition.RAISED
        ]
    return raised
