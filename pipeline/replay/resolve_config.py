"""The configuration to replay a recording with: the one given, or the one that the recording contains."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from fantwin.pipeline.config.loading import load_config, parse_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.recordings.metadata import CONFIGURATION
from fantwin.pipeline.recordings.reading import RecordingError, RecordingMetadata, read_metadata
from fantwin.schemas.envelope import Envelope


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
    return _parsed(file, metadata, [*_recorded_overrides(file, metadata), *overrides], stages)


def _parsed(file: Path, metadata: RecordingMetadata, overrides: Iterable[str], stages: Iterable[str]) -> Config:
    text = metadata.attachments[CONFIGURATION].decode(errors="replace")
    return parse_config(text, Path(f"{file}:{CONFIGURATION}"), overrides, stages)


def _recorded_overrides(file: Path, metadata: RecordingMetadata) -> list[str]:
    try:
        return [str(override) for override in json.loads(metadata.metadata.get("overrides", "[]"))]
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{file}: its metadata are damaged: overrides are not a list") from error


def trays_of(files: Iterable[Path]) -> set[str]:
    """The trays in the metadata of recordings."""
    named = (read_metadata(file).metadata.get("trays", "") for file in files)
    return {tray for trays in named for tray in trays.split(",") if tray}
