"""Section `[notifier]`."""

from __future__ import annotations

import re
from datetime import time
from pathlib import Path
from typing import Any, Literal, Self
from urllib.parse import urlsplit
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from pydantic import Field, field_validator, model_validator

from fantwin.pipeline.config.models import Name, Section
from fantwin.pipeline.runtime.stage import StageConfig

_TIME = re.compile(r"([01][0-9]|2[0-3]):[0-5][0-9]")


class QuietHours(Section):
    """A time of day during which messages are held; when it ends, one message lists what was held."""

    begin: str = Field(description='time of day, such as "22:00"')
    end: str = Field(description='time of day, such as "06:30"; if earlier than begin, on the next day')
    sent_from: Literal["alarm", "none"] = Field(
        default="alarm",
        description="messages about alarms of at least this severity are sent anyway; none: all are held",
    )

    @field_validator("begin", "end")
    @classmethod
    def _is_time(cls, value: str) -> str:
        if not _TIME.fullmatch(value):
            raise ValueError('hours and minutes, such as "22:00"')
        return value

    @property
    def times(self) -> tuple[time, time]:
        """Its begin and its end."""
        return time.fromisoformat(self.begin), time.fromisoformat(self.end)

    @model_validator(mode="after")
    def _has_a_length(self) -> Self:
        if self.begin == self.end:
            raise ValueError(f"begin and end are both {self.begin}")
        return self


class TargetConfig(Section):
    """Who gets messages, and which."""

    name: Name = Field(description="unique name of the target: letters, digits, `_` and `-`")
    kind: Literal["apprise", "alertmanager"] = Field(
        default="apprise",
        description="apprise: mail, chat, webhook or any other of its services; alertmanager: that of Prometheus",
    )
    url_file: Path | None = Field(
        default=None, description="file with the URL in its first line; only its owner may be able to read it"
    )
    url_env: str = Field(default="", description="environment variable that holds the URL, instead of a file")
    url: str = Field(default="", description="address of an Alertmanager without a password")
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
    quiet_hours: QuietHours | None = Field(default=None, description="hours in which messages are held")

    @property
    def least_severity(self) -> int:
        """Number of that severity in schemas.enums.Severity."""
        return 2 if self.severity == "alarm" else 1

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = [name for name in ("url_file", "url_env", "url") if getattr(self, name)]
        if len(given) != 1:
            raise ValueError(f"target {self.name}: give one of url_file and url_env: a URL holds secrets")
        if self.kind == "apprise":
            if self.url:
                raise ValueError(f"target {self.name}: a URL holds secrets: write it into a file, and give url_file")
            return self
        if self.url and (urlsplit(self.url).password or urlsplit(self.url).scheme not in ("http", "https")):
            raise ValueError(f"target {self.name}: url: http:// or https://, without a password (that: url_file)")
        if self.escalation_after_s or self.quiet_hours or "repeat_s" in self.model_fields_set:
            raise ValueError(
                f"target {self.name}: an Alertmanager repeats, escalates and holds by itself: take out repeat_s, "
                "escalation_after_s and quiet_hours"
            )
        return self


class NotifierConfig(StageConfig):
    """Who gets messages about alarms."""

    target: tuple[TargetConfig, ...] = Field(default=(), description="one table `[[notifier.target]]` for each target")
    page: str = Field(
        default="", pattern=r"^(https?://\S+)?$", description="address of the operators' page, for a link in messages"
    )
    timezone: str = Field(
        default="",
        description='time zone of quiet hours and of times in messages, such as "Europe/Berlin"; "": that of the host',
    )

    @field_validator("target", mode="before")
    @classmethod
    def _are_tables(cls, value: Any) -> Any:
        if isinstance(value, dict):
            raise ValueError("write [[notifier.target]], with two brackets on each side: there may be several")
        return value

    @field_validator("timezone")
    @classmethod
    def _is_known(cls, value: str) -> str:
        try:
            if value:
                ZoneInfo(value)
        except (ZoneInfoNotFoundError, ValueError, OSError) as error:
            raise ValueError(f"unknown time zone {value!r}; such as Europe/Berlin") from error
        return value

    @field_validator("target")
    @classmethod
    def _names_differ(cls, value: tuple[TargetConfig, ...]) -> tuple[TargetConfig, ...]:
        names = [target.name for target in value]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two targets are called {name!r}")
        return value

    @property
    def zone(self) -> ZoneInfo | None:
        """None: that of the host."""
        return ZoneInfo(self.timezone) if self.timezone else None
