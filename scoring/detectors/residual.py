"""One residual of a tray: standardised, less its baseline, and the statistics on it, each in its own limit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from schemas.messages import Array
from scoring.baseline.baseline import Baseline, BaselineSettings
from scoring.detectors.cusum import Cusum
from scoring.detectors.low_pass import LowPass
from scoring.detectors.variance_growth import Spread
from scoring.limits import FanOffsets, ResidualLimits, Timing, smoothed_deviation, summed_deviation

CAP = 2.0  # the residual counts no further than so many limits
CUSUM_CAP = 1.05  # nor a CUSUM: what is forgotten late clears late, and a shift that only lasts is a warning
LEAST_CLIP = 5.0  # healthy deviations
LARGEST = 1e6  # of them, so that what follows stays finite
FASTEST = 3.0  # of the baseline's speed: offsets grow no further


@dataclass(frozen=True, eq=False)
class Judged:
    """What became of a stretch. ratios: (3, n, fans), step, drift and spread in their limits."""

    smoothed: Array
    """(n, fans) the low-passed residual, sigma"""
    standard: Array
    """(n, fans) the residual in how much it varies there"""
    ratios: Array


class Residual:
    """Of one kind; baselines and statistics of every fan."""

    def __init__(self, fans: int, limits: ResidualLimits, timing: Timing) -> None:
        self._limits = limits
        self._of_fans = np.array(limits.fans.offset_sigmas).T if limits.fans else np.zeros((1, fans))
        """(speeds, fans)"""
        if self._of_fans.shape[1] != fans:
            raise ValueError(f"limits of {self._of_fans.shape[1]} fans for {fans}")
        self._timing = timing
        adaptation = max(timing.adaptation_s / timing.baseline_s, 1.0)
        self.baseline = Baseline(
            fans,
            BaselineSettings(
                limits.baseline_sigmas,
                limits.adaptation_sigmas,
                adaptation,
                limits.mean_spread,
                limits.baseline_ridge,
                limits.baseline_usual_sigmas,
            ),
        )
        self.shown = LowPass(fans, timing.smoothing_s)
        self.low_pass = LowPass(fans, timing.smoothing_s)
        self._drift_s = summed_deviation(limits.autocorrelation_time_s, 0.01)
        cap = math.inf if limits.drift is None else CUSUM_CAP * limits.drift * self._drift_s
        self.cusum = Cusum(fans, limits.reference_sigmas, cap)
        self.spread = Spread(fans, timing.smoothing_s)

    @property
    def is_judged(self) -> bool:
        """Whether any statistic of it has a limit."""
        limits = self._limits
        return any(limit is not None for limit in (limits.step, limits.drift, limits.growth))

    def usual(self, speed_rad_s: Array) -> Array:
        """(n, fans) what the healthy residual is at these speeds (n, fans), in sigma of each fan."""
        limits, speed = self._limits, np.abs(np.nan_to_num(speed_rad_s))
        usual = np.interp(speed, limits.speeds_rad_s, limits.offset_sigmas)
        return usual if limits.fans is None else usual + self._own(limits.fans, speed)

    def _own(self, fans: FanOffsets, speed: Array) -> Array:
        """(n, fans) of each fan, between the speeds by interpolation."""
        last = len(fans.speeds_rad_s) - 1
        place = np.interp(speed, fans.speeds_rad_s, np.arange(last + 1.0))
        before = np.minimum(place.astype(int), max(last - 1, 0))
        column = np.arange(speed.shape[1])
        low = self._of_fans[before, column]
        return low + (place - before) * (self._of_fans[np.minimum(before + 1, last), column] - low)

    def learn(self, standard: Array, shape: Array, speed_rad_s: Array, valid: Array, step_s: float) -> None:
        """Note for the baseline what is not usual; one wild reading must not move it. All (n, fans)."""
        reach = self._limits.baseline_sigmas * shape + self._clip(step_s) * self._spread(speed_rad_s, valid)
        centre = self.baseline.value * shape
        self.baseline.add(np.clip(np.where(valid, standard, centre), centre - reach, centre + reach), valid, shape)

    def shape(self, speed_rad_s: Array, valid: Array) -> Array:
        """(n, fans) how large a fan's own offset is at these speeds, that at the baseline's speed being one."""
        limits = self._limits
        if limits.baseline_power == 0:
            return np.ones(speed_rad_s.shape)
        speed = np.minimum(np.where(valid, np.abs(speed_rad_s), 0.0) / limits.baseline_speed_rad_s, FASTEST)
        if limits.baseline_bend_rad_s is None:
            return speed**limits.baseline_power
        bend = limits.baseline_bend_rad_s / limits.baseline_speed_rad_s
        return speed**limits.baseline_power * (1.0 + bend) / (speed + bend)

    def judge(
        self, less_own: Array, shape: Array, speed_rad_s: Array, motion_rad_s: Array, valid: Array, step_s: float
    ) -> Judged:
        """Take a stretch. less_own: the residual less what is usual and the fan's own. valid: to be judged."""
        limits, clip = self._limits, self._clip(step_s)
        shift = np.clip(np.where(valid, less_own, 0.0), -LARGEST, LARGEST)
        shown = self.shown.update(shift, valid, step_s)
        spread = self._spread(speed_rad_s, valid)
        raw = shift / spread
        lasting = self._lasting(shape, speed_rad_s, motion_rad_s, valid)
        z = np.clip(raw / lasting, -clip, clip)  # one wild reading must not raise an alarm
        smoothed = self.low_pass.update(z, valid, step_s)
        drift = self.cusum.update(z, valid, step_s)
        growth = self.spread.update(np.clip(raw, -clip, clip), valid, step_s)
        ratios = np.stack(
            (
                np.abs(smoothed) / (self._deviation(step_s) * (limits.step or math.inf)),
                drift / (self._drift_s * (limits.drift or math.inf)),
                np.maximum(growth - limits.usual_growth, 0.0) / ((limits.growth or math.inf) - limits.usual_growth),
            )
        )
        return Judged(shown, z, ratios)

    def limit_sigmas(self, step_s: float) -> float:
        """How far the smoothed residual may be from its baseline, sigma; infinite where that is not judged.

        It is a little more or less at speeds where healthy residuals vary more or less than on average, and more while
        the speed changes.
        """
        limits = self._limits
        return self._deviation(step_s) * limits.step * limits.mean_spread if limits.step else math.inf

    def lasting_limit_sigmas(self, step_s: float) -> float:
        """How far a shift that lasts may be from the commissioned baseline, sigma; infinite where that is not judged.

        The baseline follows up to its own limit, and what is then left is found by the drift, where that is judged.
        """
        limits = self._limits
        left = math.inf if limits.drift is None else limits.reference_sigmas * limits.mean_spread
        return limits.adaptation_sigmas + min(left, self.limit_sigmas(step_s))

    def _clip(self, step_s: float) -> float:
        return max(LEAST_CLIP, CAP * self._deviation(step_s) * (self._limits.step or 0.0))

    def _deviation(self, step_s: float) -> float:
        return smoothed_deviation(self._timing.smoothing_s, self._limits.autocorrelation_time_s, step_s)

    def _spread(self, speed_rad_s: Array, valid: Array) -> Array | float:
        limits = self._limits
        if len(limits.speeds_rad_s) == 1:
            return limits.spread[0]
        return np.where(valid, np.interp(np.abs(speed_rad_s), limits.speeds_rad_s, limits.spread), 1.0)

    def _lasting(self, shape: Array, speed_rad_s: Array, motion_rad_s: Array, valid: Array) -> Array | float:
        """How much more what lasts varies here than where it varies least, and where a fan's own offset is known."""
        limits = self._limits
        more: Array | float = limits.lasting[0]
        if len(limits.lasting) > 1:
            more = np.where(valid, np.interp(np.abs(speed_rad_s), limits.speeds_rad_s, limits.lasting), 1.0)
        if limits.motion_rad_s is not None:
            more = more * np.sqrt(1.0 + np.square(motion_rad_s / limits.motion_rad_s))
        if limits.baseline_usual_sigmas > 0.0:
            # what an unknown offset adds is then within the drift's reference value
            more = more + np.where(valid, self.baseline.unknown(shape), 0.0) / limits.reference_sigmas
        return more

    def forget(self, fans: Array) -> None:
        """Begin the statistics of some fans anew, (fans,) of bool; baselines stay."""
        self.shown.reset(fans)
        self.low_pass.reset(fans)
        self.cusum.reset(fans)
        self.spread.reset(fans)
