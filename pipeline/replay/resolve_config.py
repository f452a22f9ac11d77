"""Where a recording is replayed: site, trays and bus, from a configuration or from the recording itself."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from pipeline.config.models import Config, load_config, parse_config
from pipeline.recordings.metadata import CONFIGURATION
from pipeline.recordings.reading import Entry, RecordingError, RecordingMetadata, read_metadata
from pipeline.replay.live.sender import tray_of


def resolve_config(file: Path, first: Entry, config: Path | None, overrides: Iterable[str]) -> Config:
    """The configuration to replay with: the one given, else the one attached to `file`, else site and trays out of the
    recording, and defaults. `first` is the recording's first message.

    Raises:
        ConfigError: it cannot be used.
        RecordingError: the file cannot be read.
    """
    if config is not None:
        return load_config(config, overrides)
    head = read_metadata(file)
    if CONFIGURATION in head.attachments:
        # where its own processes met is over; those who listen now are where the file says, or at the default
        recorded = [override for override in _recorded_overrides(file, head) if not override.startswith("bus.")]
        return _parsed(file, head, [*recorded, *overrides])
    trays = head.metadata.get("trays") or tray_of(first.key)
    sections = [f"[[tray]]\nname = {json.dumps(tray)}\nfans = 1\n" for tray in trays.split(",")]  # fans do not matter
    return parse_config(f"site = {json.dumps(first.key.split('/')[1])}\n{''.join(sections)}", file, overrides)


def attached_config(file: Path, head: RecordingMetadata, overrides: Iterable[str] = ()) -> Config | None:
    """The configuration that a recording was made with, `overrides` on top of it; None where there is none.

    Raises:
        ConfigError: it cannot be used any more.
        RecordingError: what was set on top of it cannot be read.
    """
    if CONFIGURATION not in head.attachments:
        return None
    return _parsed(file, head, [*_recorded_overrides(file, head), *overrides])


def _parsed(file: Path, head: RecordingMetadata, overrides: Iterable[str]) -> Config:
    text = head.attachments[CONFIGURATION].decode(errors="replace")
    return parse_config(text, Path(f"{file}:{CONFIGURATION}"), overrides)


def _recorded_overrides(file: Path, head: RecordingMetadata) -> list[str]:
    try:
        return [str(override) for override in json.loads(head.metadata.get("overrides", "[]"))]
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{file}: its metadata are damaged: overrides are no list") from error


def trays_of(files: Iterable[Path]) -> set[str]:
    """The trays that recordings say they hold."""
    named = (read_metadata(file).metadata.get("trays", "") for file in files)
    return {tray for trays in named for tray in trays.split(",") if tray}
