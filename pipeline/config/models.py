"""The configuration: one TOML file for all stages, checked before anything starts.

Sections `bus`, `launcher` and `[[tray]]` are the pipeline's own; every other section bears the name of a
stage and is checked by the model that stage declares. Unknown keys are refused with the nearest known one.
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator, model_validator

from pipeline.config.registry import STAGES, load_stage
from pipeline.devices.sample_source import SourceConfig
from pipeline.devices.source_kinds import parse_source
from pipeline.errors import UserError
from schemas.topics import RESERVED_TRAY_NAMES
from schemas.units import SpeedUnit

NAME_PATTERN = r"^[A-Za-z0-9_-]+$"
Name = Annotated[str, Field(pattern=NAME_PATTERN)]


class ConfigError(UserError):
    """A configuration that cannot be used: one line that says which file, which key and what to do."""


class _Section(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class BusConfig(_Section):
    """How processes find one another. On one host the first process to start listens on `endpoint`, the others
    connect there and learn of each other; if it dies, the next to start takes its place."""

    mode: Literal["peer", "client"] = "peer"
    endpoint: str = Field(
        default="tcp/127.0.0.1:7447", description="where peers meet, or the router's address for clients"
    )
    recovery_timeout_s: float = Field(
        default=5.0, gt=0, description="how long to wait for missed messages asked for again"
    )


class LauncherConfig(_Section):
    """How `fantwin up` looks after the stages."""

    stages: tuple[str, ...] = Field(default=tuple(STAGES), description="which stages run, any order")
    restart_delay_s: float = Field(default=0.2, gt=0, description="first pause before a dead stage is started again")
    restart_delay_max_s: float = Field(default=10.0, gt=0, description="the pause doubles up to this")
    stop_timeout_s: float = Field(
        default=10.0, gt=0, description="how long a stage may take to stop before it is killed"
    )

    @field_validator("stages")
    @classmethod
    def _known(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for name in value:
            if name not in STAGES:
                raise ValueError(f"unknown stage {name!r}{_nearest(name, STAGES)}")
        return value


class TrayConfig(_Section):
    """One tray of fans whose samples come from one source.

    `port`, `baud` and `protocol` written directly in [[tray]] are the short form of
    `source = { kind = "serial", port = ..., baud = ..., protocol = ... }`.
    """

    short_form_keys: ClassVar[tuple[str, ...]] = ("port", "baud", "protocol")

    name: Name
    fans: int = Field(ge=1, le=64, description="how many fans every sample has")
    source: Annotated[SourceConfig, BeforeValidator(parse_source)] = Field(
        default={"kind": "serial"}, validate_default=True, description="where samples come from; used by acquisition"
    )
    speed_unit: SpeedUnit = Field(default="rad/s", description="unit of speed at the source and in what is displayed")
    speed_max: float = Field(default=1e5, gt=0, description="a speed beyond this, in speed_unit, is refused")
    command_min: float = Field(default=0.0, description="smallest command the device may send or be sent")
    command_max: float = Field(default=1.0, description="largest command the device may send or be sent")
    twin: Path | None = Field(default=None, description="ONNX file of the healthy twin")

    @model_validator(mode="before")
    @classmethod
    def _expand_short_form(cls, values: Any) -> Any:
        """Turn `port = ...` into a serial source: short to write, and all that older configurations have."""
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


@dataclass(frozen=True)
class Config:
    """A checked configuration. `sections` holds one config object for each stage of the table."""

    path: Path
    text: str
    overrides: tuple[str, ...]
    site: str
    run_folder: Path
    bus: BusConfig
    launcher: LauncherConfig
    trays: tuple[TrayConfig, ...]
    sections: Mapping[str, BaseModel]

    @property
    def folder(self) -> Path:
        """Where relative paths of the file start."""
        return self.path.parent

    def tray(self, name: str) -> TrayConfig:
        """The tray called `name`.

        Raises:
            ConfigError: no such tray.
        """
        for tray in self.trays:
            if tray.name == name:
                return tray
        raise ConfigError(f"{self.path}: no tray called {name!r}{_nearest(name, [t.name for t in self.trays])}")


class _File(_Section):
    site: Name = "site"
    run_folder: Path = Path("runs")
    bus: BusConfig = BusConfig()
    launcher: LauncherConfig = LauncherConfig()
    tray: tuple[TrayConfig, ...] = Field(min_length=1)


def load_config(path: Path, overrides: Iterable[str] = ()) -> Config:
    """Read and check a configuration file; `overrides` are `key=value` pairs such as `scorer.on_delay_s=1.0`.

    Raises:
        ConfigError: the file is missing, is not UTF-8, is not TOML, or holds a wrong key or value.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the configuration: {error.strerror}; give one with -c FILE") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: the configuration is not UTF-8 (byte {error.start}); save it as UTF-8") from error
    return parse_config(text, path, overrides)


def parse_config(text: str, path: Path, overrides: Iterable[str] = ()) -> Config:
    """Check the text of a configuration; `path` names it in errors and anchors its relative paths.

    Raises:
        ConfigError: see `load_config`.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    overrides = tuple(overrides)
    for override in overrides:
        _override(table, override)
    own = {key: value for key, value in table.items() if key not in STAGES}
    for key in own:
        if key not in _File.model_fields:
            raise ConfigError(f"{path}: unknown key {key!r}{_nearest(key, [*_File.model_fields, *STAGES])}")
    file = _check(_File, own, path, "")
    sections = {name: _check(load_stage(name).config, table.get(name, {}), path, name) for name in STAGES}
    names = [tray.name for tray in file.tray]
    if len(set(names)) != len(names):
        raise ConfigError(f"{path}: two trays bear the same name; names must differ: {', '.join(names)}")
    folder = path.parent
    return Config(
        path=path,
        text=text,
        overrides=overrides,
        site=file.site,
        run_folder=Path(os.path.normpath(folder / file.run_folder)),
        bus=file.bus,
        launcher=file.launcher,
        trays=file.tray,
        sections=sections,
    )


def _override(table: dict[str, Any], override: str) -> None:
    """Set one dotted key; `tray.0.port` is the port of the first tray."""
    dotted, equals, value_text = override.partition("=")
    if not equals:
        raise ConfigError(f"--set {override}: write KEY=VALUE, for example --set scorer.on_delay_s=1.0")
    try:
        value = tomllib.loads(f"value = {value_text}")["value"]
    except tomllib.TOMLDecodeError as error:
        value = value_text.strip()  # a bare word is a string
        if value.startswith(("'", '"')):
            raise ConfigError(f"--set {override}: not a TOML string: {error}; write it in double quotes") from error
    here: Any = table
    *parents, last = (int(part) if part.isascii() and part.isdecimal() else part for part in dotted.strip().split("."))
    try:
        for part in parents:
            here = here[part] if isinstance(part, int) else here.setdefault(part, {})
        here[last] = value
    except (IndexError, TypeError, AttributeError) as error:
        raise ConfigError(f"--set {override}: the configuration has no such place") from error


_Model = TypeVar("_Model", bound=BaseModel)


def _check(model: type[_Model], values: Any, path: Path, section: str) -> _Model:
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: {section!r} must be a section, write [{section}]")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{path}: {_first_problem(error, model, section)}") from error


def _first_problem(error: ValidationError, model: type[BaseModel], section: str) -> str:
    # a misspelt key is both unknown and missing: it is the unknown one that says what to mend
    first = min(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    where = ".".join(str(part) for part in ((section,) if section else ()) + first["loc"])
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    if first["type"] == "extra_forbidden":
        known = _keys_at(model, first["loc"][:-1])
        return f"unknown key {where!r}{_nearest(str(first['loc'][-1]), known)}{more}"
    if first["type"] == "missing":
        return f"{where!r} is missing{more}"
    message = first["msg"].removeprefix("Value error, ")
    return f"{where} = {first['input']!r}: {message[0].lower()}{message[1:]}{more}"


def _keys_at(model: type[BaseModel], location: Iterable[int | str]) -> list[str]:
    """The keys allowed at a place in a nested model."""
    here: Any = model
    for part in location:
        here = here.model_fields[part].annotation if isinstance(part, str) else get_args(here)[0]
    return [*here.model_fields, *getattr(here, "short_form_keys", ())]


def _nearest(word: str, known: Iterable[str]) -> str:
    known = list(known)
    close = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(known)}"
