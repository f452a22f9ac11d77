"""The configuration: one TOML file for all stages, checked before anything starts; and the twin of a tray added to it.

Sections `bus`, `launcher` and `[[tray]]` are the pipeline's own; every other section has the name of a stage and is
checked by the model that the stage declares. Unknown keys are refused with the nearest known one. Only the stages whose
sections are checked are imported.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, Field, ValidationError
from pydantic_core import ErrorDetails

from fantwin.pipeline.config.hosts import each_tray
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import (
    BusConfig,
    Config,
    ConfigError,
    ConfigUsageError,
    LauncherConfig,
    Name,
    Section,
    TrayConfig,
    nearest,
)
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.files import replace_file
from fantwin.pipeline.plugins import LEFT_OUT
from fantwin.pipeline.sources.kinds import SOURCE_KINDS, source_config
from fantwin.pipeline.sources.source import SourceConfig
from fantwin.schemas.formats import CONFIGURATION

_HEADER = re.compile(r"^([ \t]*)\[\[[ \t]*tray[ \t]*\]\][^\r\n]*(\r?)$", re.MULTILINE)


def with_twin(text: str, tray: str, twin: str, path: Path) -> str:
    """The text of a configuration in which the tray of this name gets this twin. path: the file, for the error.

    All else stays as its user wrote it.

    Raises:
        ConfigError: there is no place for it that is certain to be right, so its user has to add it.
    """
    entry = f"twin = {json.dumps(twin, ensure_ascii=False)}"
    wanted = _table_with_twin(text, tray, twin)
    for header in _HEADER.finditer(text):
        end = header.end()
        added = f"{text[:end]}\n{header[1]}{entry}{header[2]}{text[end:]}"
        if wanted is not None and _table(added) == wanted:
            return added
    raise ConfigError(f"{path}: {entry} cannot be added: write tray {tray} as one section [[tray]] without twin")


def write_twin(settings: Config, tray: str, twin: Path) -> str:
    """Write the twin of a tray into the configuration; returns its path as it is written there.

    Raises:
        UserError: the file cannot be changed.
    """
    resolved, folder = twin.resolve(), settings.folder.resolve()
    entry = str(resolved.relative_to(folder)) if resolved.is_relative_to(folder) else str(resolved)
    path = settings.path.resolve()
    try:
        text = with_twin(
            path.read_bytes().decode(), tray, entry, settings.path
        )  # its user may have edited it meanwhile
        replace_file(path, text.encode())
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f'{settings.path}: cannot be changed ({error}): add twin = "{entry}" to tray {tray}') from error
    return entry


def _table_with_twin(text: str, name: str, twin: str) -> dict[str, Any] | None:
    """What the text says, with the twin; None if it has not exactly one tray of this name, or that names a twin."""
    table = _table(text) or {}
    try:
        (tray,) = (tray for tray in table["tray"] if tray["name"] == name)
    except (KeyError, ValueError, TypeError):
        return None
    if "twin" in tray:
        return None
    tray["twin"] = twin
    return table


def _table(text: str) -> dict[str, Any] | None:
    """What a text says; None if it is not TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return None


LARGEST_FILE_BYTES = 1 << 20
LONGEST_OVERRIDE = 1000
"""characters of one `--set`"""
LONGEST_SHOWN = 100
"""characters of a key or value in an error"""
MOST_SHOWN = 5
"""problems of a section"""


class File(Section):
    """The whole file without the sections of stages."""

    format: int = Field(default=CONFIGURATION.written, description="format number of this file")
    site: Name = Field(default="site", description="name of the site: it begins the keys on the bus")
    run_folder: Path = Field(default=Path("runs"), description="where recordings, snapshots and logs are written")
    bus: BusConfig = BusConfig()
    launcher: LauncherConfig = LauncherConfig()
    tray: tuple[TrayConfig, ...] = Field(min_length=1)


def load_config(path: Path, overrides: Iterable[str] = (), stages: Iterable[str] | None = None) -> Config:
    """Read and check a configuration file.

    Args:
        path: the file.
        overrides: keys set on top of it, `key=value`, such as `scorer.alarm_share=1.0`.
        stages: the stages whose sections are checked, and which are imported for that; None: all enabled stages.

    Raises:
        ConfigError: the file is missing, too large, is not UTF-8, is not TOML, or holds a wrong key or value.
    """
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE_BYTES + 1)
        if len(content) > LARGEST_FILE_BYTES:
            raise ConfigError(f"{path}: larger than {LARGEST_FILE_BYTES:,} bytes, so no configuration; see -c FILE")
        text = content.decode("utf-8").replace("\r\n", "\n")
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the configuration: {error.strerror}; give one with -c FILE") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: the configuration is not UTF-8 (byte {error.start}); save it as UTF-8") from error
    return parse_config(text, path, overrides, stages)


def parse_config(
    text: str,
    path: Path,
    overrides: Iterable[str] = (),
    stages: Iterable[str] | None = None,
) -> Config:
    """Check the text of a configuration; `path` names it in errors and is where relative paths start.

    Raises:
        ConfigError: see `load_config`.
    """
    overrides = tuple(overrides)
    try:
        try:
            table = tomllib.loads(text)
        except ValueError as error:  # an integer of more than 4,300 digits is one, too
            raise ConfigError(f"{path}: not valid TOML: {error}") from error
        for override in overrides:
            set_key(table, override)
        return _checked(table, text, path, overrides, stages)
    except RecursionError as error:
        raise ConfigError(f"{path}: tables or lists are nested too deeply; two levels are enough") from error


def _checked(
    table: dict[str, Any], text: str, path: Path, overrides: tuple[str, ...], stages: Iterable[str] | None
) -> Config:
    if refusal := CONFIGURATION.refusal(table.get("format", CONFIGURATION.written)):
        raise ConfigError(f"{path}: {refusal}")
    own = {key: value for key, value in table.items() if key not in STAGES and key not in LEFT_OUT}
    for key in own:
        if key not in File.model_fields:
            raise ConfigError(f"{path}: unknown key {_shown(key)}{nearest(key, [*File.model_fields, *STAGES])}")
    if "tray" in own:
        try:
            own["tray"] = each_tray(own["tray"])
        except ValueError as error:
            raise ConfigError(f"{path}: tray: {error}") from error
    file = checked_section(File, own, path, "", overrides)
    enabled = enabled_stages(file.launcher, table)
    sections = {
        name: checked_section(STAGES[name].load().config, table.get(name, {}), path, name, overrides)
        for name in (enabled if stages is None else stages)
    }
    names = [tray.name for tray in file.tray]
    if twice := [name for name, times in Counter(names).items() if times > 1]:
        raise ConfigError(f"{path}: two trays have the same name; names must differ: {_shown(', '.join(twice))}")
    _require_trays_for_shards(file.launcher, len(names), path)
    folder, bus = path.parent, file.bus
    if bus.security:
        bus = bus.model_copy(update={"security": bus.security.within(folder)})
    return Config(
        path=path,
        text=text,
        overrides=overrides,
        site=file.site,
        run_folder=Path(os.path.normpath(folder / file.run_folder)),
        bus=bus,
        launcher=file.launcher,
        trays=file.tray,
        stages=enabled,
        sections=sections,
    )


def _require_trays_for_shards(launcher: LauncherConfig, trays: int, path: Path) -> None:
    for stage in STAGES:
        number = launcher.number_of_shards(stage)
        if number is not None and number > trays:
            key = f"launcher.shards.{stage}" if isinstance(launcher.shards, dict) else "launcher.shards"
            raise ConfigError(f"{path}: {key} = {number}: more shards than trays, of which there are {trays}")


def enabled_stages(launcher: LauncherConfig, table: Mapping[str, Any]) -> tuple[str, ...]:
    """The stages that a configuration enables, in the order of the data flow. `launcher.stages` overrides the rows'
    `enabled_by`, and `launcher.without` both; `table` is the whole configuration."""
    learns = any("twin" not in tray for tray in table["tray"])
    enabled = launcher.stages
    if enabled is None:
        enabled = tuple(
            name
            for name, row in STAGES.items()
            if row.enabled_by == "default" or name in table or (row.enabled_by == "tray without twin" and learns)
        )
    return tuple(name for name in STAGES if name in enabled and name not in launcher.without)


def set_key(table: dict[str, Any], override: str) -> None:
    """Set one dotted key; `tray.0.port` is the port of the first tray.

    Raises:
        ConfigUsageError: it is not KEY=VALUE, or cannot be set in this table.
    """
    if len(override) > LONGEST_OVERRIDE:
        raise ConfigUsageError(f"--set {override[:LONGEST_SHOWN]}...: longer than {LONGEST_OVERRIDE:,} characters")
    dotted, equals, value_text = override.partition("=")
    if not equals:
        raise ConfigUsageError(f"--set {override}: write KEY=VALUE, for example --set scorer.alarm_share=1.0")
    try:
        value = tomllib.loads(f"value = {value_text}")["value"]
    except tomllib.TOMLDecodeError as error:
        value = value_text.strip()  # a bare word is a string
        if value.startswith(("'", '"')):
            why = f"not a TOML string: {error}; write it in double quotes"
            raise ConfigUsageError(f"--set {override}: {why}") from error
    here: Any = table
    *parents, last = dotted.strip().split(".")
    try:
        for part in parents:
            here = here[int(part)] if isinstance(here, list) else here.setdefault(part, {})
        here[int(last) if isinstance(here, list) else last] = value
    except (IndexError, TypeError, AttributeError, ValueError) as error:
        raise ConfigUsageError(f"--set {override}: the configuration has no such key") from error


_Model = TypeVar("_Model", bound=BaseModel)


def checked_section(
    model: type[_Model], values: Any, path: Path, section: str, overrides: Iterable[str] = ()
) -> _Model:
    """A section of the file `path` as its model; an empty name is that of the whole file. overrides: set on top of it.

    Raises:
        ConfigError: a key or a value is wrong; one line names the nearest known key.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: {section!r} must be a section, write [{section}]")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(_problems(error, model, section, path, overrides)) from error


def _problems(
    error: ValidationError, model: type[BaseModel], section: str, path: Path, overrides: Iterable[str]
) -> str:
    """What is wrong in a section, in one line; of what was set on the command line, the file is not to blame."""
    # a list whose only entry is wrong counts as too short, too: what is wrong within it says what to correct
    found = error.errors()
    found = [each for each in found if not any(_is_within(other["loc"], each["loc"]) for other in found)]
    # a misspelt key is both unknown and missing: the unknown one says what to correct
    misspelt = [each["loc"][:-1] for each in found if each["type"] == "extra_forbidden"]
    found = [each for each in found if each["type"] != "missing" or each["loc"][:-1] not in misspelt]
    found.sort(key=lambda each: each["type"] != "extra_forbidden")
    more = f" (and {len(found) - MOST_SHOWN} more)" if len(found) > MOST_SHOWN else ""
    keys = [f"{override.partition('=')[0].strip()}." for override in overrides]
    is_set = all(any(f"{_where(each, section)}.".startswith(key) for key in keys) for each in found)
    problems = "; ".join(_problem(each, model, section) for each in found[:MOST_SHOWN])
    return f"{'--set' if is_set else path}: {problems}{more}"


def _where(found: ErrorDetails, section: str) -> str:
    return ".".join(str(part) for part in ((section,) if section else ()) + found["loc"])


def _problem(found: ErrorDetails, model: type[BaseModel], section: str) -> str:
    where = _where(found, section)
    if found["type"] == "extra_forbidden":
        known = _keys_at(model, found["loc"][:-1])
        return f"unknown key {_shown(where)}{nearest(str(found['loc'][-1]), known)}"
    if found["type"] == "missing":
        return f"{where!r} is missing"
    message = found["msg"].removeprefix("Value error, ")
    may_be_secret = found["loc"][-1:] == ("url",)  # somebody has written a password into it
    given = "" if may_be_secret or isinstance(found["input"], dict) else f" = {_shown(found['input'])}"
    return f"{where}{given}: {message[0].lower()}{message[1:]}"


def _is_within(location: tuple[int | str, ...], outer: tuple[int | str, ...]) -> bool:
    return len(location) > len(outer) and location[: len(outer)] == outer


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."


def _plain(annotation: Any) -> Any:
    """The type of a key, whatever else is said about it, and without None."""
    if get_origin(annotation) is Annotated:
        return _plain(get_args(annotation)[0])
    others = [each for each in get_args(annotation) if each is not NoneType]
    return _plain(others[0]) if get_origin(annotation) in (UnionType, Union) and len(others) == 1 else annotation


def _keys_at(model: type[BaseModel], location: Iterable[int | str]) -> list[str]:
    """The keys allowed at a place in a nested model."""
    here: Any = model
    for part in location:
        if here is SourceConfig:  # the settings of a kind, which has this key
            here = next(model for model in map(source_config, SOURCE_KINDS) if part in model.model_fields)
        here = _plain(here.model_fields[part].annotation if isinstance(part, str) else get_args(here)[0])
    return [*here.model_fields, *getattr(here, "short_form_keys", ())]
