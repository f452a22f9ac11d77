"""One residual of a tray's fans: the expected part subtracted, the rest in healthy standard deviations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from schemas.messages import Array
from scoring.baseline.baseline import Baseline, BaselineState, IntervalSums
from scoring.baseline.healthy_residual import FanOffsets
from scoring.baseline.intervals import Intervals
from scoring.baseline.joint_shared_offset import JointSharedOffset
from scoring.baseline.shared_offset import LEAST_FANS, SharedOffset
from scoring.baseline.speed_scaling import speed_scaling
from scoring.column_state import ColumnState
from scoring.detectors.detector import DetectorContext, Signal
from scoring.detectors.deviation import smoothed_deviation
from scoring.detectors.drift import DEFAULT_REFERENCE_SIGMAS, DriftSettings
from scoring.detectors.low_pass import LowPass
from scoring.detectors.smoothed import SmoothedSettings
from scoring.limits import Limits
from scoring.residual_samples import JOINED, JoinedResidual, ResidualSamples, SampledResidual, ScoredResidual
from scoring.unseen_error import RANGE_STDS

CLIP_LIMITS = 2.0  # residuals are clipped to this many limits of the smoothed one: one outlier raises no alarm
MIN_CLIP_STDS = 5.0
SEEN_SIGMAS = 0.5  # where its own error may be larger, baselines do not learn
LARGEST_SIGMAS = 1e6  # so that sums and squares stay finite


class Residual:
    """The speed residual or the torque balance, with the baseline of every fan."""

    def __init__(self, fans: int, source: Signal, limits: Limits) -> None:
        healthy = limits.residual(source)
        offsets = healthy.fan_offsets
        self._fan_offsets = np.array(offsets.offset_sigmas).T if offsets else np.zeros((1, fans))
        """(speeds, fans)"""
        if self._fan_offsets.shape[1] != fans:
            raise ValueError(f"limits of {self._fan_offsets.shape[1]} fans for {fans}")
        self._healthy = healthy
        self._smoothing_s = limits.timing.smoothing_s
        smoothed, drift = limits.settings_of(source, SmoothedSettings), limits.settings_of(source, DriftSettings)
        self._smoothed_limit = smoothed.limit if smoothed else 0.0
        self._reference_sigmas = drift.reference_sigmas if drift else DEFAULT_REFERENCE_SIGMAS
        intervals = max(limits.timing.adaptation_s / limits.timing.baseline_s, 1.0)
        self.baseline = Baseline(fans, healthy.baseline, intervals, healthy.mean_residual_std)
        self._shared = None
        if healthy.shared_limit and fans >= LEAST_FANS:
            self._shared = SharedOffset(
                fans,
                limit=healthy.shared_limit,
                residual_std=healthy.mean_residual_std,
                interval_s=limits.timing.baseline_s,
                adaptation_s=limits.timing.adaptation_s,
                reach_sigmas=healthy.baseline.adaptation_limit_sigmas,
            )
        self._sharing: SharedOffset | JointSharedOffset | None = self._shared
        """the same; while several trays are scored in one pass, that of each"""
        self._low_pass = LowPass(fans, self._smoothing_s)

    def share_as(self, of_trays: Sequence[Residual]) -> None:
        """Let the fans share what those of each of these trays share, which goes on there."""
        shared = [each._shared for each in of_trays if each._shared]
        self._sharing = JointSharedOffset(shared) if shared else None

    @property
    def states(self) -> tuple[ColumnState, ...]:
        """All that is kept of each fan, apart from what fans share."""
        return self.baseline, self._low_pass

    def context(self, fans: int, *, capped: bool) -> DetectorContext:
        """What the detectors of this residual are built with."""
        return DetectorContext(
            fans=fans,
            smoothing_s=self._smoothing_s,
            autocorrelation_time_s=self._healthy.autocorrelation_time_s,
            mean_residual_std=self._healthy.mean_residual_std,
            capped=capped,
        )

    def samples(
        self,
        values: Array,
        sigma: Array,
        valid: Array,
        unseen: Array,
        speed_rad_s: Array,
        transient_rad_s: Array,
        period_s: float,
    ) -> ResidualSamples:
        """What of samples does not depend on the baselines. All (n, fans); the first four: see Samples."""
        expected, scaling = self._expected(speed_rad_s), speed_scaling(self._healthy.baseline, speed_rad_s, valid)
        std, clip = self._residual_std(speed_rad_s, valid), self._clip(period_s)
        return ResidualSamples(
            valid=valid,
            residual=values - expected,
            expected=expected,
            scaling=scaling,
            std=std,
            low_frequency_std=self._low_frequency_std(speed_rad_s, transient_rad_s, valid)
            + self._of_unseen(unseen, std),
            seen=unseen < SEEN_SIGMAS,
            clip=clip,
            reach=self._healthy.baseline.commissioning_limit_sigmas * scaling + clip * std,
            speed_sigmas=np.divide(speed_rad_s, sigma, out=np.zeros(valid.shape), where=valid).clip(
                -LARGEST_SIGMAS, LARGEST_SIGMAS
            ),
        )

    def over(self, of: ResidualSamples, intervals: Intervals, moving: Array | None) -> SampledResidual:
        """The residual over samples of the present interval and later ones.

        moving: (intervals, fans), see Movement; None for a single interval, which does not end here.
        """
        baseline, scaling, commissioned = self.baseline, of.scaling, self._commissioned
        learned = of.valid & (of.seen | baseline.is_commissioning)
        if self._sharing is None:
            return SampledResidual(of, intervals, None, np.zeros(of.valid.shape), of.residual, learned)
        if not commissioned.any():
            offset, known = of.residual, of.valid & of.seen
        else:
            offset, known = of.residual - baseline.commissioned * scaling, of.valid & commissioned & of.seen
        over = self._sharing.over(offset, of.speed_sigmas, known, intervals, commissioned, moving)
        shared = intervals.spread(over.values) * of.speed_sigmas
        return SampledResidual(of, intervals, over, shared, of.residual - shared, learned)

    def runs_up_to(self, sampled: SampledResidual) -> int:
        """How many of the intervals may be scored before the first of them has ended by `end_interval`."""
        sums = self.baseline.sums(sampled.residual, sampled.learned, sampled.of.scaling, sampled.intervals)
        ends = self.baseline.refined_up_to(sums, sampled.intervals.expected)
        return min(ends, sampled.over.ends) if sampled.over else ends

    def score(self, sampled: SampledResidual, below_half_limit: Array) -> ScoredResidual:
        """Compare samples with the baselines, which learn from each interval but the last.

        below_half_limit: (intervals, fans) see `end_interval`.
        """
        of, residual = sampled.of, sampled.residual
        state, sums, own = self._learned(sampled, below_half_limit)
        scored = of.valid & sampled.intervals.spread(state.is_set)
        shift = np.where(scored, residual - own, 0.0).clip(-LARGEST_SIGMAS, LARGEST_SIGMAS)
        standardised = shift / of.std
        persistent_std = self._persistent_std(of.low_frequency_std, of.scaling, self.baseline.learned_scale)
        return ScoredResidual(
            scored=scored,
            standardised=standardised.clip(-of.clip, of.clip),
            persistent=(standardised / persistent_std).clip(-of.clip, of.clip),
            shift=shift,
            baseline=own + sampled.shared,
            shared=sampled.shared,
            intervals=sampled.intervals,
            state=state,
            sums=sums,
        )

    def _learned(self, sampled: SampledResidual, below_half_limit: Array) -> tuple[BaselineState, IntervalSums, Array]:
        """The baselines in each interval, the sums that they learn from, and (n, fans) the baselines at each sample.

        Samples far from the baseline are clipped, so that one outlier does not move it. Where any is, what is learned
        depends on the baseline that it is clipped by: then it is found again, until it stays. The first interval is
        right at once, and each time one more.
        """
        of, intervals, baseline = sampled.of, sampled.intervals, self.baseline

        def clipped(state: BaselineState) -> tuple[Array, Array]:
            own = intervals.spread(state.value) * of.scaling
            return np.where(of.valid, sampled.residual, own).clip(own - of.reach, own + of.reach), own

        if len(intervals) == 1:
            known, own = clipped(state := baseline.state)
            return state, baseline.sums(known, sampled.learned, of.scaling, intervals), own
        known = sampled.residual
        while True:
            sums = baseline.sums(known, sampled.learned, of.scaling, intervals)
            state = baseline.refined(sums, intervals.expected, below_half_limit)
            before, (known, own) = known, clipped(state)
            if np.array_equal(known[sampled.learned], before[sampled.learned], equal_nan=True):
                return state, sums, own

    def take(self, sampled: SampledResidual, scored: ScoredResidual) -> None:
        """Go on in the last of the intervals."""
        self.baseline.take(scored.state, scored.sums)
        if self._sharing and sampled.over:
            self._sharing.take(sampled.over)

    def joined(self, parts: Sequence[ScoredResidual]) -> JoinedResidual:
        """What was scored in successive parts."""
        state, columns, spread = parts[0].state, [getattr(parts[0], name) for name in JOINED], parts[0].intervals.spread
        if len(parts) > 1:
            state = BaselineState(*(np.concatenate(of) for of in zip(*(part.state for part in parts), strict=True)))
            columns = [np.concatenate([getattr(part, name) for part in parts]) for name in JOINED]
            spread = partial(np.repeat, repeats=np.concatenate([part.intervals.lengths for part in parts]), axis=0)
        of_intervals = (
            np.where(state.is_commissioning, np.nan, state.commissioned),
            self._independent_intervals(state),
            self.baseline.at_limit(state),
            state.learned_scale,
        )
        return JoinedResidual(*columns, *map(spread, of_intervals))

    def end_interval(
        self,
        samples: int,
        within_limit: Array,
        below_half_limit: Array,
        moving: Array,
        few_readings: Array,
    ) -> None:
        """End the interval; see Baseline.end_interval."""
        at_first = not self.is_commissioned
        if self._sharing:
            is_known = self._sharing.is_known
            alone = self._sharing.end_interval(samples, self._commissioned, below_half_limit, moving, at_first=at_first)
            below_half_limit = below_half_limit & ~alone
            if at_first and self._sharing.is_known and not is_known:
                within_limit = np.zeros_like(within_limit)  # this interval does not know yet what is shared
        self.baseline.end_interval(samples, within_limit, below_half_limit, moving, few_readings)
        if self._shared and at_first and self.is_commissioned:
            self._shared.begin_from_here()

    @property
    def is_commissioned(self) -> bool:
        """Whether a fan has a baseline to be measured against."""
        return bool(self._commissioned.any())

    @property
    def _commissioned(self) -> Array:
        """(fans,) which fans have a baseline to be measured against."""
        return self.baseline.is_set & ~self.baseline.is_commissioning

    def restart(self, fans: Array) -> None:
        """Commission some fans again, (fans,) of bool."""
        self.baseline.restart(fans)
        if self._shared:
            self._shared.restart(fans)

    @property
    def shared_offset(self) -> float:
        """What the fans have come to share since they were commissioned, for each rad/s of their speed, in the unit of
        the residual."""
        return self._shared.since_commissioning if self._shared else 0.0

    def _independent_intervals(self, state: BaselineState) -> Array:
        """The number of independent intervals whose mean would vary as much as baseline and shared part do."""
        own = self.baseline.independent_intervals(state)
        if self._sharing is None:
            return own
        return own * self._sharing.independent_intervals / (own + self._sharing.independent_intervals)

    def smooth(self, of: JoinedResidual, period_s: float) -> Array:
        """(n, fans) the low-passed residual less its baseline, sigma, as displayed; NaN where not scored."""
        return np.where(of.scored, self._low_pass.update(of.shift, of.scored, period_s), np.nan)

    def _expected(self, speed_rad_s: Array) -> Array:
        healthy, speed = self._healthy, np.where(np.isnan(speed_rad_s), 0.0, np.abs(speed_rad_s))
        expected = np.interp(speed, healthy.speeds_rad_s, healthy.expected_residual_sigmas)
        return expected if healthy.fan_offsets is None else expected + self._fan_offset(healthy.fan_offsets, speed)

    def _fan_offset(self, offsets: FanOffsets, speed: Array) -> Array:
        """(n, fans) of each fan, interpolated between the speeds."""
        last = len(offsets.speeds_rad_s) - 1
        place = np.interp(speed, offsets.speeds_rad_s, np.arange(last + 1.0))
        before = np.minimum(place.astype(int), max(last - 1, 0))
        column = np.arange(speed.shape[1])
        low = self._fan_offsets[before, column]
        return low + (place - before) * (self._fan_offsets[np.minimum(before + 1, last), column] - low)

    def limit_std(self, speed_rad_s: Array, learned_scale: Array | None = None, unseen: Array | float = 0.0) -> Array:
        """(fans,) what limits of a constant residual are relative to at these constant speeds (fans,), sigma.

        learned_scale: see Baseline.offset_uncertainty. unseen: see Samples.
        """
        speed, still = speed_rad_s[np.newaxis], np.zeros((1, len(speed_rad_s)))
        valid = np.isfinite(speed)
        scaling = speed_scaling(self._healthy.baseline, speed, valid)
        residual_std = self._residual_std(speed, valid)
        low_frequency_std = self._low_frequency_std(speed, still, valid) + self._of_unseen(unseen, residual_std)
        uncertain = np.where(valid, scaling, 0.0)
        learned = self.baseline.learned_scale if learned_scale is None else learned_scale
        relative = self._persistent_std(low_frequency_std, uncertain, learned)
        std: Array = residual_std * relative
        return std[0]

    @property
    def memory_s(self) -> float:
        """How long samples affect the smoothed residual."""
        return self._low_pass.memory_s

    def reset(self, fans: Array) -> None:
        """Start the low-pass again for some fans, (fans,) of bool; baselines stay."""
        self._low_pass.reset(fans)

    def snapshot(self) -> dict[str, Any]:
        """The state as JSON can hold it."""
        return {
            "baseline": self.baseline.snapshot(),
            "low_pass": self._low_pass.snapshot(),
            **({"shared": self._shared.snapshot()} if self._shared else {}),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a snapshot. Raises as ColumnState.restore does."""
        self.baseline.restore(state["baseline"])
        self._low_pass.restore(state["low_pass"])
        if self._shared:
            self._shared.restore(state["shared"])

    def _clip(self, period_s: float) -> float:
        deviation = smoothed_deviation(self._smoothing_s, self._healthy.autocorrelation_time_s, period_s)
        return max(MIN_CLIP_STDS, CLIP_LIMITS * deviation * self._smoothed_limit)

    def _residual_std(self, speed_rad_s: Array, valid: Array) -> Array:
        healthy = self._healthy
        if len(healthy.speeds_rad_s) == 1:
            return np.full(speed_rad_s.shape, healthy.residual_std[0])
        return np.where(valid, np.interp(np.abs(speed_rad_s), healthy.speeds_rad_s, healthy.residual_std), 1.0)

    def _low_frequency_std(self, speed_rad_s: Array, transient_rad_s: Array, valid: Array) -> Array:
        """Of the low-frequency residual, relative to its median: by speed, by motion, and by fan."""
        healthy = self._healthy
        relative: Array = np.full(speed_rad_s.shape, healthy.persistent_std[0])
        if len(healthy.persistent_std) > 1:
            at_speed = np.interp(np.abs(speed_rad_s), healthy.speeds_rad_s, healthy.persistent_std)
            relative = np.where(valid, at_speed, 1.0)
        if healthy.transient_scale_rad_s is not None:
            relative = relative * np.sqrt(1.0 + np.square(transient_rad_s / healthy.transient_scale_rad_s))
        if healthy.low_frequency_std_of_fans:
            relative = relative * np.array(healthy.low_frequency_std_of_fans)
        return relative

    def _of_unseen(self, unseen: Array | float, std: Array) -> Array:
        """What it adds: an error of RANGE_STDS standard deviations stays within the reference value of the drift."""
        return RANGE_STDS * unseen / (std * self._reference_sigmas)

    def _persistent_std(self, low_frequency_std: Array, scaling: Array, learned_scale: Array) -> Array:
        """The same with an uncertain baseline: an unknown offset stays within the reference value of the drift."""
        if self._healthy.baseline.rms_sigmas <= 0.0:
            return low_frequency_std
        return low_frequency_std + self.baseline.offset_uncertainty(scaling, learned_scale) / self._reference_sigmas
