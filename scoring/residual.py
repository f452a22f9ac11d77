"""One residual of a tray's fans: the expected part subtracted, the rest in healthy standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.messages import Array
from scoring.baseline.baseline import Baseline
from scoring.baseline.healthy_residual import FanOffsets
from scoring.baseline.speed_scaling import speed_scaling
from scoring.detectors.detector import DetectorContext, Signal
from scoring.detectors.deviation import smoothed_deviation
from scoring.detectors.drift import DEFAULT_REFERENCE_SIGMAS, DriftSettings
from scoring.detectors.low_pass import LowPass
from scoring.detectors.smoothed import SmoothedSettings
from scoring.limits import Limits

CLIP_LIMITS = 2.0  # residuals are clipped to this many limits of the smoothed one: one outlier raises no alarm
MIN_CLIP_STDS = 5.0
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
        self._low_pass = LowPass(fans, self._smoothing_s)

    def context(self, fans: int, *, capped: bool) -> DetectorContext:
        """What the detectors of this residual are built with."""
        return DetectorContext(
            fans=fans,
            smoothing_s=self._smoothing_s,
            autocorrelation_time_s=self._healthy.autocorrelation_time_s,
            mean_residual_std=self._healthy.mean_residual_std,
            capped=capped,
        )

    def expected(self, speed_rad_s: Array) -> Array:
        """(n, fans) the mean healthy residual at these speeds (n, fans), in sigma of each fan."""
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

    def scaling(self, speed_rad_s: Array, valid: Array) -> Array:
        """(n, fans) the baseline at these speeds, relative to that at the reference speed."""
        return speed_scaling(self._healthy.baseline, speed_rad_s, valid)

    def learn(self, residual: Array, scaling: Array, speed_rad_s: Array, valid: Array, period_s: float) -> None:
        """Add samples to the interval of the baseline. All (n, fans); residual: less the expected one, sigma.

        Samples far from the baseline are clipped, so that one outlier does not move it.
        """
        limit = self._healthy.baseline.commissioning_limit_sigmas
        reach = limit * scaling + self._clip(period_s) * self._residual_std(speed_rad_s, valid)
        centre = self.baseline.value * scaling
        clipped = np.where(valid, residual, centre).clip(centre - reach, centre + reach)
        self.baseline.add(clipped, valid, scaling)

    def smooth(self, shift: Array, valid: Array, period_s: float) -> Array:
        """(n, fans) the low-passed residual less its baseline, sigma, as displayed."""
        return self._low_pass.update(_finite(shift, valid), valid, period_s)

    def standardise(
        self, shift: Array, scaling: Array, speed_rad_s: Array, transient_rad_s: Array, valid: Array, period_s: float
    ) -> tuple[Array, Array]:
        """The residual in healthy standard deviations, and in those of its low frequencies; see DetectorInput.

        All (n, fans). shift: the residual less the expected one and the baseline, sigma.
        """
        clip = self._clip(period_s)
        standardised = _finite(shift, valid) / self._residual_std(speed_rad_s, valid)
        persistent = standardised / self._persistent_std(scaling, speed_rad_s, transient_rad_s, valid)
        return standardised.clip(-clip, clip), persistent.clip(-clip, clip)

    def limit_std(self, speed_rad_s: Array, learned_scale: Array | None = None) -> Array:
        """(fans,) what limits of a constant residual are relative to at these constant speeds (fans,), sigma.

        learned_scale: see Baseline.offset_uncertainty.
        """
        speed, still = speed_rad_s[np.newaxis], np.zeros((1, len(speed_rad_s)))
        valid = np.isfinite(speed)
        scaling = self.scaling(speed, valid)
        relative = self._residual_std(speed, valid) * self._persistent_std(scaling, speed, still, valid, learned_scale)
        return np.broadcast_to(relative, speed.shape)[0]

    @property
    def memory_s(self) -> float:
        """How long samples affect the smoothed residual."""
        return self._low_pass.memory_s

    def reset(self, fans: Array) -> None:
        """Start the low-pass again for some fans, (fans,) of bool; baselines stay."""
        self._low_pass.reset(fans)

    def snapshot(self) -> dict[str, Any]:
        """The state as JSON can hold it."""
        return {"baseline": self.baseline.snapshot(), "low_pass": self._low_pass.snapshot()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a snapshot. Raises as ColumnState.restore does."""
        self.baseline.restore(state["baseline"])
        self._low_pass.restore(state["low_pass"])

    def _clip(self, period_s: float) -> float:
        deviation = smoothed_deviation(self._smoothing_s, self._healthy.autocorrelation_time_s, period_s)
        return max(MIN_CLIP_STDS, CLIP_LIMITS * deviation * self._smoothed_limit)

    def _residual_std(self, speed_rad_s: Array, valid: Array) -> Array | float:
        healthy = self._healthy
        if len(healthy.speeds_rad_s) == 1:
            return healthy.residual_std[0]
        return np.where(valid, np.interp(np.abs(speed_rad_s), healthy.speeds_rad_s, healthy.residual_std), 1.0)

    def _persistent_std(
        self,
        scaling: Array,
        speed_rad_s: Array,
        transient_rad_s: Array,
        valid: Array,
        learned_scale: Array | None = None,
    ) -> Array | float:
        """Of the low-frequency residual, relative to its median: by speed, by motion, and by an uncertain baseline."""
        healthy = self._healthy
        relative: Array | float = healthy.persistent_std[0]
        if len(healthy.persistent_std) > 1:
            at_speed = np.interp(np.abs(speed_rad_s), healthy.speeds_rad_s, healthy.persistent_std)
            relative = np.where(valid, at_speed, 1.0)
        if healthy.transient_scale_rad_s is not None:
            relative = relative * np.sqrt(1.0 + np.square(transient_rad_s / healthy.transient_scale_rad_s))
        if healthy.baseline.rms_sigmas > 0.0:
            # so that an unknown offset stays within the reference value of the drift
            uncertainty = np.where(valid, self.baseline.offset_uncertainty(scaling, learned_scale), 0.0)
            relative = relative + uncertainty / self._reference_sigmas
        return relative


def _finite(shift: Array, valid: Array) -> Array:
    return np.where(valid, shift, 0.0).clip(-LARGEST_SIGMAS, LARGEST_SIGMAS)
