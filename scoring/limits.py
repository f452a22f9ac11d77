"""What the statistics are judged by: how a healthy residual varies, and how far each statistic may go.

`fantwin calibrate` writes this into the twin's card as `calibration`; docs/how-to/calibrate.md explains each entry. A
twin that was not calibrated gets limits on its speed residual alone, from the scorer's settings.
"""

from __future__ import annotations

import math
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

FORMAT_VERSION = 1
NEVER_S = 1e9


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class FanOffsets(_Part):
    """What the healthy residual of each fan is at these speeds, either way round. offset_sigmas: (fans, speeds)."""

    speeds_rad_s: tuple[float, ...] = Field(min_length=1)
    offset_sigmas: tuple[tuple[float, ...], ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _consistent(self) -> FanOffsets:
        if list(self.speeds_rad_s) != sorted(set(self.speeds_rad_s)):
            raise ValueError("speeds_rad_s must rise")
        if any(len(row) != len(self.speeds_rad_s) for row in self.offset_sigmas):
            raise ValueError("offset_sigmas must have one value for each of speeds_rad_s")
        return self

    def of(self, fans: range) -> FanOffsets:
        """Of some fans."""
        return self.model_copy(update={"offset_sigmas": tuple(self.offset_sigmas[fan] for fan in fans)})


class ResidualLimits(_Part):
    """Of one residual; sigma is the card's, of each fan.

    fans: what it is at each speed of each fan, where the twin knows them one by one and that was seen. speeds_rad_s,
    offset_sigmas, spread: what is left on average at these speeds, either way round, and how much it varies, in sigma;
    between them by interpolation. Limits are None where a statistic is not used. step:
    of the low-passed residual in its own standard deviations. drift: of the CUSUM in standard deviations of a second's
    sum, with reference_sigmas. growth: of the spread, that is usual_growth on average. baseline_sigmas: how far a fan's
    own offset may be from none. adaptation_sigmas: how far the baseline may follow afterwards.

    lasting: how much more than usual, at these speeds or at all, what lasts of the healthy residual varies;
    motion_rad_s: and where a fan moves by so much (scoring.detectors.motion), root two times as much as where its
    speed holds,
    None for no more. baseline_power: a fan's own offset goes with this power of the speed, from baseline_bend_rad_s on
    with one less, and baselines are those at baseline_speed_rad_s. 0 where friction is what differs from day to day, 2
    where it is the density of the air: then the balance is off by a part of the drag, and the speed by that in what a
    little more speed needs, viscous + 2 drag w, which bends at viscous / (2 drag). baseline_ridge is the variance of
    what baselines cannot follow in that of healthy ones, and baseline_usual_sigmas the root mean square of these.
    """

    fans: FanOffsets | None = None
    speeds_rad_s: tuple[float, ...] = (0.0,)
    offset_sigmas: tuple[float, ...] = (0.0,)
    spread: tuple[float, ...] = (1.0,)
    lasting: tuple[float, ...] = (1.0,)
    motion_rad_s: float | None = Field(default=None, gt=0)
    autocorrelation_time_s: float = Field(default=0.0, ge=0)
    step: float | None = Field(default=None, gt=0)
    drift: float | None = Field(default=None, gt=0)
    reference_sigmas: float = Field(default=0.5, gt=0)
    growth: float | None = Field(default=None, gt=0)
    usual_growth: float = Field(default=0.0, ge=0)
    baseline_sigmas: float = Field(default=1.0, ge=0)
    adaptation_sigmas: float = Field(default=1.0, ge=0)
    baseline_power: int = Field(default=0, ge=0, le=2)
    baseline_speed_rad_s: float = Field(default=1.0, gt=0)
    baseline_bend_rad_s: float | None = Field(default=None, gt=0)
    baseline_ridge: float = Field(default=0.0, ge=0)
    baseline_usual_sigmas: float = Field(default=0.0, ge=0)

    @property
    def mean_spread(self) -> float:
        """How much the healthy residual varies, over all speeds alike."""
        return sum(self.spread) / len(self.spread)

    def times(self, factor: float) -> ResidualLimits:
        """The same with statistics that may go so many times as far."""
        return self.each_times(factor, factor, factor)

    def each_times(self, step: float, drift: float, growth: float) -> ResidualLimits:
        """The same with each statistic's own factor."""
        more: dict[str, float] = {"adaptation_sigmas": self.adaptation_sigmas * step}
        if self.step is not None:
            more["step"] = self.step * step
        if self.drift is not None:
            more["drift"] = self.drift * drift
        if self.growth is not None:
            more["growth"] = self.usual_growth + (self.growth - self.usual_growth) * growth
        return self.model_copy(update=more)

    @model_validator(mode="after")
    def _consistent(self) -> ResidualLimits:
        knots = len(self.speeds_rad_s)
        if not knots == len(self.offset_sigmas) == len(self.spread) > 0 or len(self.lasting) not in (1, knots):
            raise ValueError("speeds_rad_s, offset_sigmas and spread must be of one length, and lasting too, or of one")
        if list(self.speeds_rad_s) != sorted(set(self.speeds_rad_s)):
            raise ValueError("speeds_rad_s must rise")
        if min(*self.spread, *self.lasting) <= 0:
            raise ValueError("spread and lasting must be above zero")
        if self.growth is not None and self.growth <= self.usual_growth:
            raise ValueError("growth must be above usual_growth")
        return self


class Timing(_Part):
    """The times that limits hold for; with others they would mean another false-alarm rate."""

    smoothing_s: float = Field(default=0.2, ge=0)
    baseline_s: float = Field(default=1.0, gt=0)
    adaptation_s: float = Field(default=60.0, gt=0)
    on_delay_s: float = Field(default=0.1, ge=0)


class DeclaredRate(_Part):
    """What was declared, and what healthy running it rests on. rates: false alarms per fan and day.

    interval_95: of the rate that these limits have, by the healthy running that they were set on. extrapolated: limits
    lie beyond what that running could show, and nothing is promised.
    """

    false_alarms_per_day: float = Field(gt=0)
    interval_95: tuple[float, float]
    extrapolated: bool
    fan_hours: float = Field(gt=0)
    runs: int = Field(ge=1)
    data: tuple[dict[str, Any], ...] = ()
    created: str = ""


class Limits(_Part):
    """All limits of a twin."""

    format_version: int = FORMAT_VERSION
    speed: ResidualLimits
    balance: ResidualLimits
    stuck_s: float = Field(default=5.0, gt=0)
    missing_share: float = Field(default=0.25, gt=0, le=1)
    timing: Timing = Timing()
    promise: DeclaredRate | None = None

    def of(self, fans: range | None) -> Limits:
        """For a tray of some of the fans; None: of fans that the twin does not know one by one."""

        def part(of: ResidualLimits) -> ResidualLimits:
            return of.model_copy(update={"fans": of.fans.of(fans) if of.fans and fans is not None else None})

        return self.model_copy(update={"speed": part(self.speed), "balance": part(self.balance)})

    def times(self, factor: float) -> Limits:
        """All statistics may go so many times as far; what was promised is then no longer."""
        if factor == 1.0:
            return self
        parts = {name: getattr(self, name).times(factor) for name in ("speed", "balance")}
        return self.model_copy(update={**parts, "stuck_s": self.stuck_s * factor, "promise": None})


def uncalibrated(alarm_sigmas: float, timing: Timing) -> Limits:
    """Limits of a twin that was not calibrated: the smoothed speed residual may be alarm_sigmas, and that is all."""
    return Limits(
        # of a residual that hardly ever changes the low-pass takes nothing away: the limit is in sigma at any rate
        speed=ResidualLimits(step=alarm_sigmas, autocorrelation_time_s=NEVER_S),
        balance=ResidualLimits(),
        stuck_s=NEVER_S,
        missing_share=1.0,
        timing=timing,
    )


def smoothed_deviation(smoothing_s: float, autocorrelation_time_s: float, step_s: float) -> float:
    """Standard deviation of a low-passed residual of standard deviation one, first-order autoregressive."""
    keep = math.exp(-step_s / smoothing_s) if smoothing_s > 0 else 0.0
    phi = math.exp(-step_s / autocorrelation_time_s) if autocorrelation_time_s > 0 else 0.0
    return math.sqrt((1.0 - keep) / (1.0 + keep) * (1.0 + keep * phi) / (1.0 - keep * phi))


def summed_deviation(autocorrelation_time_s: float, step_s: float) -> float:
    """Standard deviation of the sum over a second of such a residual times the step, for long sums."""
    phi = math.exp(-step_s / autocorrelation_time_s) if autocorrelation_time_s > 0 else 0.0
    return math.sqrt(step_s * (1.0 + phi) / (1.0 - phi))
