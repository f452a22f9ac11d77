"""The settings of the scorer."""

from __future__ import annotations

from pydantic import Field

from fantwin.pipeline.runtime.stage import StageConfig

FALSE_ALARMS_PER_DAY = 0.03
"""declared, of a fan, where nobody says otherwise: about one a month"""


class ScorerConfig(StageConfig):
    """Section `[scorer]`."""

    false_alarms_per_day: float | None = Field(
        default=None,
        gt=0,
        le=8640,
        description="declared rate of false alarms, per fan and day; default: that of the twin's calibration, else "
        "0.03, about one a month",
    )
    alarm_share: float = Field(
        default=0.1,
        gt=0,
        description="share of the speed: a fault that takes at least this much is an alarm, a smaller one a warning",
    )
