"""The settings of trays, bus and launcher, and the checked configuration as a whole.

The section of a stage is modelled by that stage. No stage is imported here; see `pipeline.config.loading`.
"""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.sources.kinds import parse_source
from fantwin.pipeline.sources.serial.config import MOST_FANS_ON_LINE
from fantwin.pipeline.sources.source import MOST_FANS, SourceConfig, too_many_fans
from fantwin.pipeline.sources.stand_in import OTHERS, STAND_INS
from fantwin.schemas.fan_names import LONGEST_NAME, FanNames, fan_label, is_fan_name, is_one_short_line
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, Tachos, tacho_of_each_fan
from fantwin.schemas.topics import RESERVED_TRAY_NAMES
from fantwin.schemas.units import SpeedUnit

NAME_PATTERN = r"^[A-Za-z0-9_-]+$"
LONGEST_S = 366 * 86_400
"""seconds; no duration is longer: as ns it can be added to any time without leaving 64 bits"""
LARGEST = 1 << 62
SMALLEST = 1e-9
"""of the magnitude of a number other than 0"""
Name = Annotated[str, Field(pattern=NAME_PATTERN)]


class ConfigError(UserError):
    """A configuration that cannot be used: one line that says which file, which key and what to do."""


class ConfigUsageError(ConfigError, UsageError):
    """The command line names a tray or a key that the configuration cannot have."""


def nearest(word: str, known: Iterable[str]) -> str:
    """End of an error about an unknown word: the known word most like it, or else all of them."""
    known = list(known)
    close = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(known)}"


class Section(BaseModel):
    """Base of every section: frozen, unknown keys refused, every number within bounds that arithmetic can take."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*")
    @classmethod
    def _within_bounds(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, int | float) and not isinstance(value, bool):
            is_duration = (info.field_name or "").endswith("_s")
            largest, words = (LONGEST_S, f"{LONGEST_S:,} s") if is_duration else (LARGEST, f"{LARGEST:.3g}")
            if abs(value) > largest:
                raise ValueError(f"too large: at most {words}")
            if 0 < abs(value) < SMALLEST:
                raise ValueError(f"too small: 0, or at least {SMALLEST:g}")
        return value


BETWEEN_ENDPOINTS = ", "


def _joined(value: object) -> object:
    """Several endpoints as one text; anything else as it is."""
    if isinstance(value, list | tuple) and value and all(isinstance(each, str) for each in value):
        return BETWEEN_ENDPOINTS.join(value)
    return value


OWN_ROLES = ("operator", "viewer", "source", "replay", "router")
"""roles of people and programs that are no stages"""


class SecurityConfig(Section):
    """Mutual TLS and roles. Each process shows a certificate that names its role; `fantwin certs` makes them."""

    folder: Path = Field(
        default=Path("certs"),
        description="where the certificates are: ca.pem of the site's authority, ROLE.pem of each process, and its "
        "private key ROLE.key, which only its owner may be able to read",
    )
    controllers: tuple[Name, ...] = Field(
        default=(), description="roles of programs that command fans: each has the rights of `operator`"
    )

    @field_validator("controllers")
    @classmethod
    def _are_new_roles(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for name in value:
            if name == "ca":
                raise ValueError("ca.pem is the certificate of the authority: choose another name than 'ca'")
            if name in STAGES or name in OWN_ROLES:
                raise ValueError(f"{name!r} is a role of its own, with other rights: choose another name")
        return value

    def within(self, folder: Path) -> Self:
        """The same with an absolute path: a relative one starts at `folder`."""
        return self.model_copy(update={"folder": folder.absolute() / self.folder})

    @property
    def ca(self) -> Path:
        """The certificate of the site's authority."""
        return self.folder / "ca.pem"

    def certificate(self, role: str) -> Path:
        """The certificate of a process of this role."""
        return self.folder / f"{role}.pem"

    def key(self, role: str) -> Path:
        """Its private key."""
        return self.folder / f"{role}.key"


class BusConfig(Section):
    """How processes find one another. On one host the first process to start listens on `endpoint`, the others
    connect there and learn of each other; if it dies, the next to start takes its place."""

    mode: Literal["peer", "client"] = Field(
        default="peer", description="peer: processes meet without a router; client: all go through `fantwin router`"
    )
    endpoint: Annotated[str, BeforeValidator(_joined, json_schema_input_type=str | tuple[str, ...])] = Field(
        default="tcp/127.0.0.1:7447",
        description="where peers meet, or for clients the address of the router; or a list of routers: a client uses "
        "the first that answers, and another when that one is gone",
    )
    security: SecurityConfig | None = Field(
        default=None, description="certificates and roles: docs/how-to/security.md; without it, none"
    )
    zenoh: dict[str, Any] = Field(
        default_factory=dict, description="settings of Zenoh itself, by path; not those that fantwin sets"
    )

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Each endpoint; `endpoint` is all of them, for people."""
        return tuple(self.endpoint.split(BETWEEN_ENDPOINTS))

    @model_validator(mode="after")
    def _one_for_peers(self) -> Self:
        if self.mode == "peer" and len(self.endpoints) > 1:
            raise ValueError('peers meet at one endpoint; a list is for mode = "client"')
        return self


class LauncherConfig(Section):
    """How `fantwin up` runs the stages."""

    stages: tuple[str, ...] | None = Field(
        default=None, description="which stages run, in any order; without it, all that the configuration enables"
    )
    without: tuple[str, ...] = Field(
        default=(), description='stages that do not run although they are enabled: ["gateway"] for no operators\' page'
    )
    shards: int | dict[str, int] | None = Field(
        default=None,
        description="number of processes that share the trays of a stage: one number for all stages but "
        f"{', '.join(name for name, row in STAGES.items() if not row.has_common_shards)}; or a table, such as "
        "{ scorer = 4, recorder = 2 }; without it, one process for the site, of acquisition one for each tray, but one "
        "for all of kinds redfish, prometheus, ipmi and snmp",
    )
    watchdog_s: float = Field(
        default=10.0,
        ge=1,
        description="a stage whose main loop has not run for this long is killed and restarted; one that stops and has "
        "not ended after this long is killed",
    )

    @field_validator("stages", "without")
    @classmethod
    def _known(cls, value: tuple[str, ...] | None) -> tuple[str, ...] | None:
        _require_stages(value or ())
        return value

    @field_validator("shards", mode="before")
    @classmethod
    def _number_or_table(cls, value: object) -> object:
        _require_stages(value if isinstance(value, dict) else ())
        for number in value.values() if isinstance(value, dict) else [1 if value is None else value]:
            if not isinstance(number, int) or isinstance(number, bool) or number < 1:
                raise ValueError("give a number from 1, or a table of stages with such numbers")
        return value

    def number_of_shards(self, stage: str) -> int | None:
        """As how many processes a stage runs; None: as its row of the registry says."""
        if isinstance(self.shards, dict):
            return self.shards.get(stage)
        return self.shards if STAGES[stage].has_common_shards else None


def _require_stages(names: Iterable[str]) -> None:
    for name in names:
        if name not in STAGES:
            raise ValueError(f"unknown stage {name!r}{nearest(name, STAGES)}")


class FanConfig(Section):
    """One fan of a tray, as people call it."""

    name: str = Field(default="", description="what people call the fan: `CPU`")
    place: str = Field(default="", description="where to find it: `rack 3, slot 4`")

    @field_validator("name", "place")
    @classmethod
    def _is_one_short_line(cls, value: str) -> str:
        if not is_one_short_line(value):
            raise ValueError(f"write at most {LONGEST_NAME} visible characters, without spaces at the ends")
        return value

    @field_validator("name")
    @classmethod
    def _tells_fans_apart(cls, value: str) -> str:
        if not value:
            raise ValueError("an empty name: give one, or write [[tray.fan]] for each fan and leave out name")
        if not is_fan_name(value):
            raise ValueError("a number, or `all`, is no name: it would be taken for other fans")
        return value


class TrayConfig(Section):
    """One tray of fans whose samples come from one source.

    `port`, `baud` and `protocol` written directly in [[tray]] are the short form of
    `source = { kind = "serial", port = ..., baud = ..., protocol = ... }`, and a list of names as `fans` is that of a
    [[tray.fan]] for each.
    """

    short_form_keys: ClassVar[tuple[str, ...]] = ("port", "baud", "protocol")

    name: Name = Field(description="letters, digits, `_` and `-`; names of trays differ")
    fans: int = Field(
        ge=1,
        le=MOST_FANS,
        description=f"number of fans in every sample, on a serial line at most {MOST_FANS_ON_LINE}; or a list of their "
        'names: ["CPU", "rear top"]',
    )
    fan: tuple[FanConfig, ...] = Field(
        default=(), description="instead of a list of names: one [[tray.fan]] for each fan, in their order"
    )
    source: Annotated[SourceConfig, BeforeValidator(parse_source)] = Field(
        default={"kind": "serial"}, validate_default=True, description="where samples come from; used by acquisition"
    )
    speed_unit: SpeedUnit = Field(default="rad/s", description="unit of speed at the source and in what is displayed")
    speed_max: float = Field(default=1e5, gt=0, description="a speed beyond this, in speed_unit, is refused")
    command_min: float = Field(default=0.0, description="smallest command the device may send or be sent")
    command_max: float = Field(default=1.0, description="largest command the device may send or be sent")
    command_from: Literal["", *STAND_INS] = Field(  # type: ignore[valid-type]
        default="",
        description="what stands for a command that the source does not know: the median speed of the other fans, in "
        "rpm, or a channel; command_min and command_max are then its range",
    )
    twin: Path | None = Field(default=None, description="ONNX file of the healthy twin")
    tacho: Tachos | None = Field(
        default=None,
        description="how the speed is measured: one tacho for all fans, or a list with one for each; without it, what "
        "the source states, or else instantaneous",
    )

    @property
    def tachos(self) -> tuple[Tacho, ...]:
        """How the speed is measured, one for all fans or one for each."""
        return self.tacho or self.source.stated_tachos or INSTANTANEOUS

    @property
    def stated_tachos(self) -> tuple[Tacho, ...]:
        """The same where the source states what it measures, one for all fans if they agree; empty where it does not:
        what its samples then say of themselves is no more than this file does."""
        if not self.source.stated_tachos:
            return ()
        return self.tachos[:1] if len(set(self.tachos)) == 1 else self.tachos

    @property
    def names(self) -> FanNames:
        """Names of all fans."""
        return FanNames(tuple(fan.name for fan in self.fan))

    def label(self, fan: int) -> str:
        """A fan for people: `CPU (fan 0)`."""
        return fan_label(fan, self.fan[fan].name)

    def fan_called(self, text: str) -> int:
        """The number of the fan that a user means by its number or name.

        Raises:
            ConfigUsageError: the tray has no such fan.
        """
        try:
            number = self.names.number(text)
        except ValueError as error:
            raise ConfigUsageError(f"tray {self.name}: {error}") from error
        if not 0 <= number < self.fans:
            raise ConfigUsageError(f"fan {number}: tray {self.name} has fans 0 to {self.fans - 1}")
        return number

    @model_validator(mode="before")
    @classmethod
    def _one_entry_for_each_fan(cls, values: Any) -> Any:
        """Turn `fans = [...]` and `fans = 3` into a number and an entry `fan` for each."""
        if not isinstance(values, dict):
            return values
        fans, given = values.get("fans"), values.get("fan")
        if isinstance(given, dict):
            raise ValueError("[tray.fan]: write [[tray.fan]], one for each fan")
        if given is not None and isinstance(fans, list):
            raise ValueError("fans is a list of names, and there are [[tray.fan]]: give one of the two")
        if isinstance(fans, list | tuple):
            return {**values, "fans": len(fans), "fan": [{"name": name} for name in fans]}
        if isinstance(given, list | tuple) and given:
            return {"fans": len(given), **values}
        if not given and isinstance(fans, int) and 0 < fans <= MOST_FANS:
            return {**values, "fan": [FanConfig()] * fans}
        return values

    @model_validator(mode="before")
    @classmethod
    def _expand_short_form(cls, values: Any) -> Any:
        """Turn `port = ...`, the short form, into a serial source."""
        if not isinstance(values, dict):
            return values
        short = {key: value for key, value in values.items() if key in cls.short_form_keys}
        if not short:
            return values
        if "source" in values:
            keys = ", ".join(short)
            raise ValueError(f"{keys} and source are both given; put {keys} into source = {{ ... }}")
        others = {key: value for key, value in values.items() if key not in short}
        return {**others, "source": {"kind": "serial", **short}}

    @field_validator("name")
    @classmethod
    def _not_reserved(cls, value: str) -> str:
        if value in RESERVED_TRAY_NAMES:
            raise ValueError(f"{value!r} is a reserved name")
        return value

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if len(self.fan) != self.fans:
            raise ValueError(f"fans = {self.fans}, and there are {len(self.fan)} [[tray.fan]]: name each fan, or none")
        times = Counter(fan.name.casefold() for fan in self.fan if fan.name)
        if twice := next((fan.name for fan in self.fan if times[fan.name.casefold()] > 1), ""):
            raise ValueError(f"two fans are called {twice!r}: names of a tray's fans differ")
        tacho_of_each_fan(self.tachos, self.fans)
        if self.fans > self.source.most_fans:
            raise ValueError(too_many_fans(self.source.kind, self.fans, self.source.most_fans))
        if self.command_from == OTHERS and self.fans < 2:
            raise ValueError('command_from = "others" compares the fans of a tray: it needs two or more')
        if self.command_min > self.command_max:
            raise ValueError(f"command_min = {self.command_min:g} is greater than command_max = {self.command_max:g}")
        return self


@dataclass(frozen=True)
class Config:
    """A checked configuration.

    Attributes:
        path: the file; its folder is where relative paths start.
        text: the text of the file.
        overrides: the keys set on top of it, `key=value`.
        stages: the names of the enabled stages, in the order of the data flow.
        sections: the checked section of each stage whose section was loaded.
    """

    path: Path
    text: str
    overrides: tuple[str, ...]
    site: str
    run_folder: Path
    bus: BusConfig
    launcher: LauncherConfig
    trays: tuple[TrayConfig, ...]
    stages: tuple[str, ...]
    sections: Mapping[str, BaseModel]

    @property
    def folder(self) -> Path:
        """Where relative paths of the file start."""
        return self.path.parent

    def tray(self, name: str) -> TrayConfig:
        """The tray called `name`.

        Raises:
            ConfigUsageError: no such tray.
        """
        for tray in self.trays:
            if tray.name == name:
                return tray
        raise ConfigUsageError(f"{self.path}: no tray called {name!r}{nearest(name, [t.name for t in self.trays])}")
