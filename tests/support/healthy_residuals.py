"""Streams of residuals of many fans, for tests of what judges them: first-order autoregressive, of a known memory."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from schemas.messages import Array, Statistic, Transition
from scoring.alarms.alarm_state import ConditionSettings
from scoring.alarms.tray_alarms import Conditions
from scoring.fan_scorer import FanScorer, Samples
from scoring.limits import Limits

STEP_NS = 10_000_000
BLOCK = 512


def autoregressive(samples: int, fans: int, memory_s: float, seed: int, step_s: float = 0.01) -> Array:
    """(samples, fans) of variance one; memory_s 0: white."""
    noise = np.random.default_rng(seed).normal(size=(samples, fans))
    if not memory_s:
        return noise
    phi = math.exp(-step_s / memory_s)
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
        balance=balance,
        balance_valid=np.isfinite(balance),
        missing=np.zeros(speed.shape, np.bool_),
        alive=np.ones(speed.shape, np.bool_),
    )


def rows_of(samples: Samples, rows: slice) -> Samples:
    """Some rows."""
    return replace(samples, **{name: value[rows] for name, value in vars(samples).items() if name != "period_ns"})


def in_blocks(samples: Samples, block: int = BLOCK) -> Iterator[Samples]:
    """The same, cut."""
    for first in range(0, len(samples.t_ns), block):
        yield rows_of(samples, slice(first, first + block))


@dataclass(frozen=True)
class Raised:
    """An alarm: whose, by what, and when."""

    fan: int
    t_s: float
    statistic: Statistic


def alarms_of(limits: Limits, blocks: Iterable[Samples], fans: int) -> list[Raised]:
    """Alarms that a scorer would raise."""
    judge = FanScorer(fans, limits)
    settings = ConditionSettings(round(limits.timing.on_delay_s * 1e9), 1_000_000_000)
    conditions = Conditions(fans, settings)
    raised: list[Raised] = []
    for block in blocks:
        verdict = judge.update(block)
        course = conditions.update(block.t_ns, block.period_ns, verdict.score, np.isfinite(verdict.score))
        raised += [
            Raised(
                change.fan, int(block.t_ns[change.row]) / 1e9, Statistic(int(verdict.statistic[change.row, change.fan]))
            )
            for change in course.events
            if change.transition == Transition.RAISED
        ]
    return raised
