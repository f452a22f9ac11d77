"""Where a recording is replayed: site, trays and bus, from a configuration or from the recording itself."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from pipeline.config.loading import load_config, parse_config
from pipeline.config.models import Config
from pipeline.recordings.metadata import CONFIGURATION
from pipeline.recordings.reading import RecordingError, RecordingMetadata, read_metadata
from schemas.envelope import Envelope


def resolve_config(file: Path, first: Envelope, config: Path | None, overrides: Iterable[str]) -> Config:
    """The configuration to replay with: the one given, else the one attached to `file`, else site and trays out of the
    recording, and defaults. `first` is the recording's first message.

    Raises:
        ConfigError: it cannot be used.
        RecordingError: the file cannot be read.
    """
    if config is not None:
        return load_config(config, overrides, stages=())
    head = read_metadata(file)
    if CONFIGURATION in head.attachments:
        # where its own processes met is over; those who listen now are where the file says, or at the default
        recorded = [override for override in _recorded_overrides(file, head) if not override.startswith("bus.")]
        return _parsed(file, head, [*recorded, *overrides], stages=())
    _, site, tray, *_ = first.key.split("/")
    trays = head.metadata.get("trays") or tray
    sections = [f"[[tray]]\nname = {json.dumps(tray)}\nfans = 1\n" for tray in trays.split(",")]  # fans do not matter
    return parse_config(f"site = {json.dumps(site)}\n{''.join(sections)}", file, overrides, stages=())


def attached_config(
    file: Path, head: RecordingMetadata, stages: Iterable[str], overrides: Iterable[str] = ()
) -> Config | None:
    """The configuration that a recording was made with, `overrides` on top of it; None where there is none. Only the
    sections of `stages` are checked.

    Raises:
        ConfigError: it cannot be used any more.
        RecordingError: what was set on top of it cannot be read.
    """
    if CONFIGURATION not in head.attachments:
        return None
    return _parsed(file, head, [*_recorded_overrides(file, head), *overrides], stages)


def _parsed(file: Path, head: RecordingMetadata, overrides: Iterable[str], stages: Iterable[str]) -> Config:
    text = head.attachments[CONFIGURATION].decode(errors="replace")
    return parse_config(text, Path(f"{file}:{CONFIGURATION}"), overrides, stages)


def _recorded_overrides(file: Path, head: RecordingMetadata) -> list[str]:
    try:
        return [str(override) for override in json.loads(head.metadata.get("overrides", "[]"))]
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{file}: its metadata are damaged: overrides are no list") from error


def trays_of(files: Iterable[Path]) -> set[str]:
    """The trays that recordings say they hold."""
    named = (read_metadata(file).metadata.get("trays", "") for file in files)
    return {tray for trays in named for tray in trays.split(",") if tray}
