"""A recording as a view file: what the viewer stage would have written, drawn by the same core."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fantwin.pipeline.config.settings import FanConfig, TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.rerun.rerun_sink import ViewOptions
from fantwin.pipeline.outputs.rerun.viewer_core import view_of_site
from fantwin.pipeline.recordings.left_out import how_to_score
from fantwin.pipeline.recordings.parts import in_order, read_parts
from fantwin.pipeline.recordings.reading import RecordingMetadata
from fantwin.pipeline.recordings.run_recordings import run_metadata
from fantwin.schemas.codec import CodecError
from fantwin.schemas.units import SpeedUnit

TOPICS = ("score", "alarm", "snapshot")
"""what the viewer reads"""


@dataclass(frozen=True)
class RecordedSite:
    """The site of some recordings. parts: the earliest first."""

    name: str
    trays: Sequence[TrayConfig]
    parts: Sequence[Path]


def recorded_site(recordings: Iterable[Path]) -> RecordedSite:
    """The site and those trays of it that have scores.

    Raises:
        UserError: a recording cannot be read, or has no scores.
    """
    parts = in_order(recordings)
    metadata = run_metadata(parts)
    stated = {tray: metadata.metadata.get(f"fans.{tray}") for tray in metadata.trays}
    counts = {tray: int(fans) for tray, fans in stated.items() if fans}
    trays = [_tray(metadata, tray, fans) for tray, fans in counts.items()]
    if not trays:
        raise UserError(f"{', '.join(map(str, parts))}: holds no scores to show; {how_to_score(parts)}")
    return RecordedSite(metadata.metadata.get("site", "site"), trays, parts)


def write_view(site: RecordedSite, output: Path, options: ViewOptions) -> list[str]:
    """Write the view file. Returns what could not be read, a line each.

    Raises:
        UserError: the file cannot be written, or a recording cannot be read.
    """
    damage: list[str] = []
    messages = read_parts(site.parts, TOPICS, damage)
    first = next(messages, None)
    core = view_of_site(site.name, site.trays, first.received_t_ns if first else 0, output, options)
    try:
        while first is not None:
            envelope, first = first, next(messages, None)
            core.tick(envelope.received_t_ns)
            try:
                core.step(envelope if envelope.topic == "score" else envelope.message)
            except CodecError:
                continue  # counted by the reading
    except BaseException:
        core.abort()
        raise
    core.close()
    return [*damage, *filter(None, [core.problem()])]


def _tray(metadata: RecordingMetadata, tray: str, fans: int) -> TrayConfig:
    unit: SpeedUnit = "rpm" if metadata.speed_unit(tray) == "rpm" else "rad/s"
    names = map(metadata.names(tray).name, range(fans))
    named = tuple(FanConfig(name=name) if name else FanConfig() for name in names)
    return TrayConfig(name=tray, fans=fans, fan=named, speed_unit=unit)
