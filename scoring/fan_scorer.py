"""The judge of a tray: both residuals and the tachos, and which statistic is the furthest towards its limit.

What it finds is the score: that statistic in its own limit. Above one the fan is not what it was. When an alarm comes
of it is for scoring.alarms.tray_alarms to say.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from schemas.messages import Array, InvalidReason, Prediction, Statistic
from schemas.units import NS_PER_S
from scoring.detectors.motion import Motion
from scoring.detectors.residual import Residual
from scoring.detectors.tacho import Sensor
from scoring.limits import Limits

QUIET = 0.5  # once a fan is commissioned, nothing is learnt from it with a score above


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """A block to be judged; residuals in sigma of each fan. All (n, fans) but t_ns, (n,)."""

    t_ns: Array
    period_ns: int
    speed_rad_s: Array
    speed_residual: Array
    speed_valid: Array
    balance: Array
    balance_valid: Array
    missing: Array
    """the tacho gave no reading"""
    alive: Array
    """the line gave something"""


def samples_of(prediction: Prediction) -> Samples:
    """The samples of a block of predictions. The torque balance is judged where the free run is too
    young, and where a controller asks for more than any healthy fan needed: it holds there.
    """
    invalid_reason, residual = (
        prediction.invalid_reason,
        prediction.measured_speed_rad_s - prediction.predicted_speed_rad_s,
    )
    balance = prediction.torque_balance_command
    with np.errstate(all="ignore"):
        speed_residual = residual / prediction.sigma_rad_s
        balance = balance / prediction.torque_balance_sigma_command
    speaks = np.isin(invalid_reason, (InvalidReason.NONE, InvalidReason.WARMING_UP, InvalidReason.OUT_OF_RANGE))
    return Samples(
        t_ns=prediction.t_ns,
        period_ns=prediction.period_ns,
        speed_rad_s=prediction.measured_speed_rad_s,
        speed_residual=speed_residual,
        speed_valid=prediction.valid & np.isfinite(speed_residual),
        balance=balance,
        balance_valid=speaks & np.isfinite(balance),
        missing=invalid_reason == InvalidReason.NO_SPEED,
        alive=~np.isin(invalid_reason, (InvalidReason.GAP, InvalidReason.STALE)),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoredBlock:
    """What the judge found, (n, fans) each; smoothed residuals and baselines in sigma."""

    score: Array
    """NaN where nothing could be judged"""
    statistic: Array
    commissioning: Array
    """valid, and no baseline yet"""
    speed_smoothed: Array
    speed_baseline: Array
    balance_smoothed: Array
    balance_baseline: Array
    balance_usual: Array
    """what calibration found it to be at this speed, beside the baseline"""
    balance_baseline_s: Array
    """seconds of healthy running that this baseline varies as the mean of; 0: there is none yet"""
    balance_commissioned: Array
    """what the baseline was at the end of commissioning; NaN before"""
    balance_held: Array
    """the baseline may go no further from that"""


class FanScorer:
    """Of one tray's fans. What it gives does not depend on how samples are cut into blocks."""

    def __init__(self, fans: int, limits: Limits) -> None:
        self.limits = limits
        self.speed = Residual(fans, limits.speed, limits.timing)
        self.balance = Residual(fans, limits.balance, limits.timing)
        self.sensor = Sensor(fans, limits.stuck_s, limits.missing_share)
        self.motion = Motion(fans)
        self.quiet = np.ones(fans, np.bool_)
        """(fans,) whether all was far from its limit in the present interval so far"""
        self.normal = np.ones(fans, np.bool_)
        """(fans,) whether nothing was beyond its limit"""
        self.origin_t_ns: int | None = None
        self.interval = 0
        self._interval_ns = max(1, round(limits.timing.baseline_s * NS_PER_S))
        self._watched: list[tuple[Array, ...]] | None = None

    def update(self, block: Samples) -> ScoredBlock:
        """Judge a block of at least one sample."""
        if self.origin_t_ns is None:
            self.origin_t_ns = int(block.t_ns[0])
        intervals = (block.t_ns - self.origin_t_ns) // self._interval_ns
        cuts = np.flatnonzero(np.diff(intervals)) + 1
        edges = [0, *cuts.tolist(), len(intervals)]
        verdicts = []
        for first, last in pairwise(edges):
            number = int(intervals[first])
            if number != self.interval:
                self._end_interval(block.period_ns)
                self.interval = number
            verdicts.append(self._stretch(block, slice(first, last)))
        if len(verdicts) == 1:
            return verdicts[0]
        return ScoredBlock(**{name: np.concatenate([getattr(v, name) for v in verdicts]) for name in vars(verdicts[0])})

    def watch(self) -> None:
        """Keep the ratios of all statistics, and what they are of, from now on, for `watched`; and end no sum at a cap:
        how far beyond its limit a healthy one goes is to be known.
        """
        self._watched = []
        for residual in (self.speed, self.balance):
            residual.cusum.uncap()

    def watched(self) -> tuple[Array, Array, Array, Array]:
        """Since the last call: (7, n, fans) the ratios, in the order of Statistic from 1 on; of both residuals, (2, n,
        fans) standardised, and what is usual at these speeds; (n, fans) the motion, see scoring.detectors.motion.
        """
        assert self._watched is not None
        (ratios, standard, usual, motion_rad_s), self._watched = zip(*self._watched, strict=True), []
        every, both, known = (np.concatenate(one, axis=1) for one in (ratios, standard, usual))
        return every, both, known, np.concatenate(motion_rad_s)

    def forget(self, fans: Array) -> None:
        """Take new baselines of some fans, (fans,) of bool."""
        for residual in (self.speed, self.balance):
            residual.baseline.restart(fans)
            residual.forget(fans)
        self.sensor.reset(fans)
        self.quiet[fans] = self.normal[fans] = True

    def _end_interval(self, period_ns: int) -> None:
        expected = self._interval_ns // period_ns
        for residual in (self.speed, self.balance):
            residual.forget(residual.baseline.end_interval(expected, self.normal, self.quiet))
        self.quiet[:] = self.normal[:] = True

    def _stretch(self, block: Samples, rows: slice) -> ScoredBlock:
        speed_rad_s, step_s = block.speed_rad_s[rows], block.period_ns / NS_PER_S
        parts: list[Array] = []
        standardised: list[Array] = []
        smoothed: list[Array] = []
        baselines: list[Array] = []
        usuals: list[Array] = []
        commissioned: list[Array] = []
        judged = np.zeros(speed_rad_s.shape, np.bool_)
        known = np.zeros(speed_rad_s.shape, np.bool_)
        motion_rad_s = self.motion.update(speed_rad_s, step_s)
        for residual, values, valid in (
            (self.speed, block.speed_residual[rows], block.speed_valid[rows]),
            (self.balance, block.balance[rows], block.balance_valid[rows]),
        ):
            usual = residual.usual(speed_rad_s)
            standard = values - usual
            shape = residual.shape(speed_rad_s, valid)
            own = residual.baseline.value * shape
            residual.learn(standard, shape, speed_rad_s, valid, step_s)
            may = valid & residual.baseline.is_set
            found = residual.judge(standard - own, shape, speed_rad_s, motion_rad_s, may, step_s)
            parts.append(np.where(may, found.ratios, 0.0))
            standardised.append(found.standard)
            smoothed.append(np.where(may, found.smoothed, np.nan))
            baselines.append(own)
            usuals.append(usual)
            commissioned.append(residual.baseline.commissioned * shape)
            if residual.is_judged:
                judged |= may
                known |= valid
        alive = block.alive[rows]
        sensor = self.sensor.update(speed_rad_s, block.missing[rows], alive, block.period_ns)
        ratios = np.concatenate((*parts, np.where(alive, sensor, 0.0)[np.newaxis]))
        if self._watched is not None:
            self._watched.append((ratios, np.stack(standardised), np.stack(usuals), motion_rad_s))
        largest = ratios.argmax(axis=0)
        score = np.take_along_axis(ratios, largest[np.newaxis], axis=0)[0]
        highest = score.max(axis=0)
        balance = self.balance.baseline
        self.quiet &= highest <= QUIET
        self.normal &= highest <= 1.0
        seen = judged | (alive & (score > 1.0))
        return ScoredBlock(
            score=np.where(seen, score, np.nan),
            statistic=np.where(seen, largest + 1, Statistic.NONE).astype(np.uint8),
            commissioning=known & ~judged,
            speed_smoothed=smoothed[0],
            speed_baseline=baselines[0],
            balance_smoothed=smoothed[1],
            balance_baseline=baselines[1],
            balance_usual=usuals[1],
            balance_baseline_s=np.broadcast_to(balance.weight * self.limits.timing.baseline_s, known.shape),
            balance_commissioned=np.where(balance.is_commissioning, np.nan, commissioned[-1]),
            balance_held=np.broadcast_to(balance.is_at_limit, known.shape),
        )

    def snapshot(self) -> dict[str, Any]:
        """All that it knows, as JSON can hold it."""
        return {
            "origin_t_ns": self.origin_t_ns,
            "interval": self.interval,
            **{name: _plain(column) for name, column in self._columns().items()},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a snapshot of a judge of as many fans; without it nothing has changed when this raises.

        Raises:
            ValueError, KeyError, TypeError: it is not one.
        """
        columns = self._columns()
        kept = {name: np.array(state[name], column.dtype) for name, column in columns.items()}
        origin_t_ns, interval = state["origin_t_ns"], int(state["interval"])
        for name, column in columns.items():
            if kept[name].shape != column.shape:
                raise ValueError(f"{name} of a judge of another number of fans")
        for name, column in columns.items():
            column[...] = kept[name]
        self.origin_t_ns = None if origin_t_ns is None else int(origin_t_ns)
        self.interval = interval

    def _columns(self) -> dict[str, Array]:
        columns: dict[str, Array] = {"quiet": self.quiet, "normal": self.normal}
        for name, residual in (("speed", self.speed), ("balance", self.balance)):
            baseline = residual.baseline
            columns |= {
                f"{name}_baseline": baseline.value,
                f"{name}_commissioned": baseline.commissioned,
                f"{name}_intervals": baseline.intervals,
                f"{name}_waited": baseline.waited,
                f"{name}_squares": baseline.squares,
                f"{name}_means": baseline.means,
                f"{name}_told": baseline.told,
                f"{name}_worth": baseline.worth,
                f"{name}_sums": baseline.sums,
                f"{name}_shapes": baseline.shapes,
                f"{name}_counts": baseline.counts,
                f"{name}_shown": residual.shown.value,
                f"{name}_smoothed": residual.low_pass.value,
                f"{name}_cusum": residual.cusum.sums,
                f"{name}_spread_mean": residual.spread.mean.value,
                f"{name}_square": residual.spread.square.value,
            }
        return columns | {
            "motion_past": self.motion.past.value,
            "sensor_last": self.sensor.last,
            "sensor_since_ns": self.sensor.since_ns,
            "sensor_missing": self.sensor.missing.value,
        }


def _plain(column: Array) -> Any:
    """As JSON can hold it, which has no NaN."""
    if column.dtype.kind != "f":
        return column.tolist()
    values = column.astype(object)
    values[np.isnan(column)] = None
    return values.tolist()
