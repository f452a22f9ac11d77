"""Acquisition: the readings of a tray's source in, raw samples out; commands back to the device.

Reads: topic `command` (fan commands in the tray's command unit, set-points in rad/s), and the source that `source` of
the [[tray]] names (pipeline/sources/kinds.py; speed in the tray's speed unit). Where clients push the samples of
a tray over the bus, that source is topic `reading` (time of the client in ns, command, speed in rad/s).
Writes: topic `raw`: device clock (us, wraps), device sequence (wraps), host time of receipt (ns), command, speed
(rad/s), and where the source measures them supply voltage (V), current (A), temperature (degrees Celsius).
Timing: a message holds what arrives within `block_s` (pipeline/acquisition/sample_blocks.py), and is sent when the last
of that has arrived.

One process and one core per tray (pipeline.acquisition.acquisition_core).
"""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field

from fantwin.pipeline.acquisition.acquisition_core import AcquisitionCore, limits_of
from fantwin.pipeline.acquisition.sample_blocks import (
    SampleBlocks,
)
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Stage, StageConfig, StageError
from fantwin.pipeline.sources.kinds import build_source
from fantwin.pipeline.sources.source import (
    SampleSource,
    SourceContext,
)
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.schemas.units import NS_PER_S


class AcquisitionConfig(StageConfig):
    """Section `[acquisition]`. The source itself is described by the tray."""

    block_s: float = Field(
        default=0.05, ge=0, le=1, description="a message holds the samples of this time; 0: those of one read"
    )


def build_tray_source(context: Context) -> SampleSource:
    """The source of the tray, not yet connected.

    Raises:
        StageError: a setting of the source is missing.
    """
    tray = context.tray
    try:
        return build_source(
            tray.source,
            SourceContext(
                tray.fans,
                tray.speed_unit,
                context.folder,
                tray.name,
                limits_of(tray),
                run_folder=context.run_folder,
                names=tray.names,
            ),
        )
    except UserError as error:
        raise StageError(f"[[tray]] {tray.name}: {error}") from error


def build(context: Context) -> BuiltStage:
    """The core of one tray and its source.

    Raises:
        StageError: a setting of the source is missing.
    """
    source = build_tray_source(context)
    blocks = SampleBlocks(source, round(context.config.block_s * NS_PER_S))
    core = AcquisitionCore(context.tray, source, blocks, context.started_t_ns, HOST_CLOCK)
    return BuiltStage(core, blocks)


def check(context: Context) -> list[str]:
    """Problems that would keep the source from connecting."""
    try:
        source = build_tray_source(context)
        return [] if context.is_running and context.tray.source.takes_port else source.check()
    except StageError as error:
        return [str(error)]


def topics_read(_config: AcquisitionConfig, trays: Sequence[TrayConfig]) -> tuple[str, ...]:
    """Samples of clients only where a tray takes them."""
    return ("command", "reading") if any(tray.source.takes_pushed for tray in trays) else ("command",)


STAGE = Stage(
    row=STAGES["acquisition"],
    about="readings of a tray's source to raw samples, and commands to its device",
    config=AcquisitionConfig,
    build=build,
    check=check,
    chooses=topics_read,
)
