"""Settings of fans behind Prometheus: which series are the speed and the command of each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal, Self

from prometheus_client.parser import text_string_to_metric_families
from pydantic import Field, model_validator

from fantwin.pipeline.sources.named_values import NamedFansConfig
from fantwin.pipeline.sources.polling import SLOWEST_S
from fantwin.pipeline.sources.secret_file import LogIn

NAME = "__name__"
Labels = Mapping[str, str]
"""labels of a series, its name as one of them"""


class PrometheusConfig(NamedFansConfig, LogIn, frozen=True):
    """Fans whose values a Prometheus collects, or one exporter shows. Names are series: name{label="value", ...}, with
    the labels in which they differ from others."""

    schemes: ClassVar[Mapping[str, int]] = {"http": 80, "https": 443}

    kind: Literal["prometheus"] = "prometheus"
    url: str = Field(description="Prometheus, or an exporter: https://USER@HOST:PORT")
    scrape: str = Field(
        default="",
        pattern=r"^(/\S*)?$",
        description="path of an exporter, such as /metrics; without it, url is a Prometheus",
    )
    token_file: Path | None = Field(default=None, description="file with a bearer token, instead of a user")
    ca: Path | None = Field(default=None, description="certificate of the authority that signed the server's")
    period_s: float = Field(
        default=15.0, gt=0, le=SLOWEST_S, description="time between two requests: the scrape interval"
    )
    labels: dict[str, str] = Field(default={}, description="labels of all its series")

    @model_validator(mode="after")
    def _logs_in_once_and_names_series(self) -> Self:
        if self.username and not self.password_file:
            raise ValueError("the user in url needs password_file")
        if self.username and self.token_file:
            raise ValueError("give a user in url or token_file, not both")
        for _, value in (each for fan in self.fan for each in fan.columns()):
            labels_of(value.name)
        return self


def labels_of(series: str) -> dict[str, str]:
    """The labels that a series has to have: `rpm{fan="a"}` is rpm as NAME and a as fan.

    Raises:
        ValueError: it is something else.
    """
    try:
        (family,) = text_string_to_metric_families(f"{series} 0\n")
        ((name, labels, value, time, *_),) = family.samples
        if value or time is not None:
            raise ValueError("more than a name")
    except ValueError as error:
        example = 'node_hwmon_fan_rpm{instance="node7:9100",sensor="fan1"}'
        raise ValueError(f"{series!r}: name one series, such as {example}; only = is known") from error
    return {NAME: name, **labels}
