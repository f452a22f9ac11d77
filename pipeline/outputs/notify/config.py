"""Section `[notifier]`."""

from __future__ import annotations

import re
from datetime import time
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from fantwin.pipeline.config.settings import Name, Section
from fantwin.pipeline.runtime.stage import StageConfig
from fantwin.schemas.enums import Severity

_TIME = r"([01][0-9]|2[0-3]):[0-5][0-9]"
_SPAN = re.compile(f"{_TIME}-{_TIME}")


class TargetConfig(Section):
    """Who gets messages, and which."""

    name: Name = Field(description="unique name of the target: letters, digits, `_` and `-`")
    kind: Literal["apprise", "alertmanager"] = Field(
        default="apprise",
        description="apprise: mail, chat, webhook or any other of its services; alertmanager: that of Prometheus",
    )
    url_file: Path = Field(description="file with the URL in its first line; only its owner may be able to read it")
    severity: Literal["warning", "alarm"] = Field(
        default="warning", description="least severity of the alarms that this target gets"
    )
    trays: tuple[Name, ...] = Field(default=(), description="trays whose alarms this target gets; without it, all")
    repeat_s: float = Field(
        default=3600.0,
        ge=0,
        description="an alarm that stays active and unacknowledged is sent again after this time; 0: never",
    )
    escalation_after_s: float | None = Field(
        default=None,
        gt=0,
        description="this target gets only alarms that have been unacknowledged for this long; without it, all alarms, "
        "at once",
    )
    quiet_hours: str = Field(
        default="",
        description='time of day in which messages about warnings are held, such as "22:00-06:00"; when it '
        "ends, one message lists what was held",
    )

    @property
    def least_severity(self) -> Severity:
        """`severity` as alarms have it."""
        return Severity[self.severity.upper()]

    @property
    def quiet_times(self) -> tuple[time, time] | None:
        """Begin and end of the quiet hours, the end on the next day if it is earlier; None: there are none."""
        begin, _, end = self.quiet_hours.partition("-")
        return (time.fromisoformat(begin), time.fromisoformat(end)) if self.quiet_hours else None

    @field_validator("quiet_hours")
    @classmethod
    def _is_span(cls, value: str) -> str:
        if value and (not _SPAN.fullmatch(value) or value[:5] == value[6:]):
            raise ValueError('begin and end, such as "22:00-06:00"')
        return value

    @model_validator(mode="after")
    def _check(self) -> Self:
        of_apprise = {"repeat_s", "escalation_after_s", "quiet_hours"}
        if self.kind == "alertmanager" and (found := sorted(of_apprise & self.model_fields_set)):
            by_itself = "an Alertmanager repeats, escalates and holds by itself"
            raise ValueError(f"target {self.name}: {by_itself}: take out {', '.join(found)}")
        return self


class NotifierConfig(StageConfig):
    """Who gets messages about alarms."""

    target: tuple[TargetConfig, ...] = Field(default=(), description="one table `[[notifier.target]]` for each target")
    page: str = Field(
        default="", pattern=r"^(https?://\S+)?$", description="address of the operators' page, for a link in messages"
    )

    @field_validator("target", mode="before")
    @classmethod
    def _are_tables(cls, value: Any) -> Any:
        if isinstance(value, dict):
            raise ValueError("write [[notifier.target]], with two brackets on each side: there may be several")
        return value

    @field_validator("target")
    @classmethod
    def _names_differ(cls, value: tuple[TargetConfig, ...]) -> tuple[TargetConfig, ...]:
        names = [target.name for target in value]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two targets are called {name!r}")
        return value
