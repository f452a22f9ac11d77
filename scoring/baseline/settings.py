"""Settings of the baseline of one residual, as the twin's card stores them."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class BaselineSettings(BaseModel):
    """The range of the offset of a healthy fan, and how it changes with the speed."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    commissioning_limit_sigmas: float = Field(
        default=1.0, ge=0, description="largest offset that is learned during commissioning"
    )
    adaptation_limit_sigmas: float = Field(
        default=1.0, ge=0, description="how far the baseline may then move from the commissioned one"
    )
    speed_exponent: int = Field(
        default=0, ge=0, le=2, description="the offset is proportional to this power of the speed"
    )
    reference_speed_rad_s: float = Field(default=1.0, gt=0, description="speed for which baselines are given")
    crossover_speed_rad_s: float | None = Field(
        default=None, gt=0, description="speed from which on the exponent is smaller by one; null: never"
    )
    ridge: float = Field(
        default=0.0,
        ge=0,
        description="variance of what baselines cannot follow, relative to the variance of healthy baselines: offsets "
        "that are learned at low speed are drawn towards zero by it (ridge regression)",
    )
    rms_sigmas: float = Field(default=0.0, ge=0, description="root mean square of healthy baselines")
