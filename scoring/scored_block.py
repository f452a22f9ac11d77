"""The scores of a block of samples, and what calibration sees beside them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.messages import Array
from scoring.detectors.detector import Signal


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoredBlock:
    """The scores of a block, (n, fans) each; smoothed residuals and baselines in sigma."""

    score: Array
    """NaN where nothing could be scored"""
    statistic: Array
    """schemas.messages.Statistic of the detector that the score is of"""
    commissioning: Array
    """valid, and no baseline yet"""
    judged: Array
    """scored, or stopped or starting and judged by whether it stands or turns as commanded"""
    speed_smoothed: Array
    speed_baseline: Array
    balance_smoothed: Array
    balance_baseline: Array
    balance_expected: Array
    """the expected residual at this speed, to which the baseline is added"""
    balance_baseline_s: Array
    """seconds of healthy data whose mean would vary as much as the baseline; 0: there is none yet"""
    balance_shared: Array
    """what of the baseline the fans of the tray have in common"""
    balance_commissioned: Array
    """the fan's own baseline at the end of commissioning, at the reference speed; NaN before"""
    balance_at_limit: Array
    """whether the baseline is held at the adaptation limit"""
    speed_learned_scale: Array
    balance_learned_scale: Array
    """of the baseline, see Baseline.learned_scale"""
    ratios: Array
    """(n, rows of the table, fans) every statistic in multiples of its limit; NaN where it is not scored"""

    @classmethod
    def empty(cls, n: int, rows: int, fans: int) -> ScoredBlock:
        """To be filled, with any values."""
        shape = (n, fans)
        return cls(
            score=np.empty(shape),
            statistic=np.empty(shape, np.uint8),
            commissioning=np.empty(shape, np.bool_),
            judged=np.empty(shape, np.bool_),
            speed_smoothed=np.empty(shape),
            speed_baseline=np.empty(shape),
            balance_smoothed=np.empty(shape),
            balance_baseline=np.empty(shape),
            balance_expected=np.empty(shape),
            balance_baseline_s=np.empty(shape),
            balance_shared=np.empty(shape),
            balance_commissioned=np.empty(shape),
            balance_at_limit=np.empty(shape, np.bool_),
            speed_learned_scale=np.empty(shape),
            balance_learned_scale=np.empty(shape),
            ratios=np.empty((n, rows, fans)),
        )

    def rows(self, rows: slice) -> ScoredBlock:
        """A part of the block; writing to it writes to the block."""
        return ScoredBlock(**{name: column[rows] for name, column in vars(self).items()})

    def fans(self, fans: slice) -> ScoredBlock:
        """Those of some fans, as `rows`."""
        return ScoredBlock(**{name: column[..., fans] for name, column in vars(self).items()})


@dataclass(frozen=True, eq=False, kw_only=True)
class Observation:
    """What calibration needs about some samples, beside the scores."""

    ratios: Array
    """(rows of the table, n, fans) every statistic in multiples of its limit"""
    persistent: dict[Signal, Array]
    """(n, fans) of each residual, see DetectorInput"""
    expected: dict[Signal, Array]
    """(n, fans) the expected residual at these speeds, sigma"""
    transient_rad_s: Array
    """(n, fans) see scoring.detectors.motion"""
