"""The configuration to replay a recording with: the one given, or the one that the recording contains."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable
from pathlib import Path

from pipeline.config.loading import load_config, parse_config
from pipeline.config.models import Config
from pipeline.recordings.metadata import CONFIGURATION
from pipeline.recordings.reading import RecordingError, RecordingMetadata, read_metadata
from pipeline.runtime.decision_rules import FORMER_DEFAULTS, FORMER_KEYS, DecisionRules
from schemas.envelope import Envelope


def resolve_config(file: Path, first: Envelope, config: Path | None, overrides: Iterable[str]) -> Config:
    """The configuration for a live replay: `config`, else the one attached to `file`, else defaults with the site and
    trays of the recording. `first` is the recording's first message.

    Raises:
        ConfigError: it cannot be used.
        RecordingError: the file cannot be read.
    """
    if config is not None:
        return load_config(config, overrides, stages=())
    metadata = read_metadata(file)
    if CONFIGURATION in metadata.attachments:
        # the bus of the recorded run was set on its command line; today's stages use the file's or the default
        recorded = [override for override in _recorded_overrides(file, metadata) if not override.startswith("bus.")]
        return _parsed(file, metadata, [*recorded, *overrides], stages=())
    _, site, tray, *_ = first.key.split("/")
    trays = metadata.metadata.get("trays") or tray
    # a live replay does not use `fans`
    sections = [f"[[tray]]\nname = {json.dumps(name)}\nfans = 1\n" for name in trays.split(",")]
    return parse_config(f"site = {json.dumps(site)}\n{''.join(sections)}", file, overrides, stages=())


def attached_config(
    file: Path, metadata: RecordingMetadata, stages: Iterable[str], overrides: Iterable[str] = ()
) -> Config | None:
    """The recorded configuration with `overrides` on top; None where there is none. Only the sections of `stages` are
    checked.

    Raises:
        ConfigError: it is not valid, as after an update.
        RecordingError: its recorded overrides cannot be read.
    """
    if CONFIGURATION not in metadata.attachments:
        return None
    former = _former_defaults(file, metadata)
    return _parsed(file, metadata, [*former, *_recorded_overrides(file, metadata), *overrides], stages)


def recorded_rules(file: Path, metadata: RecordingMetadata) -> DecisionRules:
    """The version of the rules that the recorded decisions were made by.

    Raises:
        RecordingError: it is of a newer version of fantwin.
    """
    version = metadata.metadata.get("decision_rules", str(int(DecisionRules.FIRST)))
    try:
        return DecisionRules(int(version))
    except ValueError as error:
        raise RecordingError(
            f"{file}: its decisions were made by rules {version!r}, which this version does not know: update fantwin"
        ) from error


def _former_defaults(file: Path, metadata: RecordingMetadata) -> list[str]:
    """Overrides that give an older recording the defaults it was recorded with, where its configuration says
    nothing.
    """
    rules = recorded_rules(file, metadata)
    try:
        given = tomllib.loads(metadata.attachments[CONFIGURATION].decode(errors="replace"))
    except ValueError:  # reported where it is parsed
        return []
    return [
        f"{section}.{key}={value}"
        for since, sections in FORMER_DEFAULTS.items()
        if rules < since
        for section, defaults in sections.items()
        for key, value in defaults.items()
        if key not in given.get(section, {})
    ]


def _parsed(file: Path, metadata: RecordingMetadata, overrides: Iterable[str], stages: Iterable[str]) -> Config:
    text = metadata.attachments[CONFIGURATION].decode(errors="replace")
    return parse_config(text, Path(f"{file}:{CONFIGURATION}"), overrides, stages, FORMER_KEYS)


def _recorded_overrides(file: Path, metadata: RecordingMetadata) -> list[str]:
    try:
        overrides = [str(override) for override in json.loads(metadata.metadata.get("overrides", "[]"))]
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{file}: its metadata are damaged: overrides are not a list") from error
    return [override for override in overrides if override.partition("=")[0].strip() not in FORMER_KEYS]


def trays_of(files: Iterable[Path]) -> set[str]:
    """The trays in the metadata of recordings."""
    named = (read_metadata(file).metadata.get("trays", "") for file in files)
    return {tray for trays in named for tray in trays.split(",") if tray}
