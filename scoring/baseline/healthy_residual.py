"""How the residual of a healthy fan behaves: its mean and standard deviation over speed, in motion and in time."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import BaseModel, ConfigDict, Field, model_validator

from scoring.baseline.settings import BaselineSettings


class FanOffsets(BaseModel):
    """The mean healthy residual of each fan over speed."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    speeds_rad_s: tuple[float, ...] = Field(min_length=1, description="speeds, rising; either direction of rotation")
    offset_sigmas: tuple[tuple[float, ...], ...] = Field(min_length=1, description="(fans, speeds), sigma of each fan")

    @model_validator(mode="after")
    def _consistent(self) -> FanOffsets:
        if list(self.speeds_rad_s) != sorted(set(self.speeds_rad_s)):
            raise ValueError("speeds_rad_s must be in strictly ascending order")
        if any(len(row) != len(self.speeds_rad_s) for row in self.offset_sigmas):
            raise ValueError("offset_sigmas must have one value for each of speeds_rad_s")
        return self

    def of(self, fans: Sequence[int]) -> FanOffsets:
        """The offsets of some of the fans."""
        return self.model_copy(update={"offset_sigmas": tuple(self.offset_sigmas[fan] for fan in fans)})


class HealthyResidual(BaseModel):
    """One residual of healthy fans. Sigma is that of the twin's card, of each fan."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    fan_offsets: FanOffsets | None = Field(
        default=None, description="mean residual of each fan; null where the twin does not know its fans one by one"
    )
    speeds_rad_s: tuple[float, ...] = Field(
        default=(0.0,), description="speeds of the next three entries, rising; values between are interpolated"
    )
    expected_residual_sigmas: tuple[float, ...] = Field(
        default=(0.0,), description="mean over fans of the residual less fan_offsets"
    )
    residual_std: tuple[float, ...] = Field(default=(1.0,), description="standard deviation of the residual, sigma")
    persistent_std: tuple[float, ...] = Field(
        default=(1.0,),
        description="standard deviation of the low-frequency residual at each speed, relative to its median over "
        "speeds, at least 1; one value for all speeds, or one a speed",
    )
    low_frequency_std_of_fans: tuple[float, ...] = Field(
        default=(),
        description="standard deviation of the low-frequency residual of each fan, relative to what its sigma says, at "
        "least 1; empty: 1",
    )
    transient_scale_rad_s: float | None = Field(
        default=None,
        gt=0,
        description="motion (scoring.detectors.motion) at which the variance of the low-frequency residual is twice "
        "that at constant speed; null: motion does not change it",
    )
    autocorrelation_time_s: float = Field(default=0.0, ge=0, description="of the residual; 0: white")
    shared_limit: float = Field(
        default=0.0,
        ge=0,
        description="largest offset that the fans of a tray may share without an alarm, for each rad/s of their speed, "
        "in the unit of the residual; 0: none",
    )
    baseline: BaselineSettings = Field(default=BaselineSettings(), description="of the fan's own offset")

    @property
    def mean_residual_std(self) -> float:
        """Mean of residual_std over its speeds."""
        return sum(self.residual_std) / len(self.residual_std)

    @model_validator(mode="after")
    def _consistent(self) -> HealthyResidual:
        knots = len(self.speeds_rad_s)
        if not knots == len(self.expected_residual_sigmas) == len(self.residual_std) > 0:
            raise ValueError("speeds_rad_s, expected_residual_sigmas and residual_std must be of one length")
        if len(self.persistent_std) not in (1, knots):
            raise ValueError("persistent_std must have one value, or one for each of speeds_rad_s")
        if list(self.speeds_rad_s) != sorted(set(self.speeds_rad_s)):
            raise ValueError("speeds_rad_s must be in strictly ascending order")
        if min(*self.residual_std, *self.persistent_std, *self.low_frequency_std_of_fans) <= 0:
            raise ValueError("standard deviations must be above zero")
        return self
