"""Recordings of raw samples that have not been on a bus: of a measured table, or of a simulated device."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.recordings.reading import NAMES_KEY, TACHO_KEY
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.sources.simulated.device import Device, PlaybackCounts
from fantwin.pipeline.sources.tables.measured_table import Table
from fantwin.schemas.blocks import cut
from fantwin.schemas.device_sample import DeviceSample
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Raw
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, tachos_to_json
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S

SITE, TRAY, PRODUCER = "simulated", "tray1", "simulate"
IMPORTED = "imported"
"""site of a table"""
SAMPLES_PER_MESSAGE = 100


def record(
    device: Device,
    path: Path,
    epoch_ns: int,
    speed_unit: str,
    tachos: Sequence[Tacho],
    progress: Callable[[float], None] = lambda _t_s: None,
) -> PlaybackCounts:
    """Write all samples of a device as Raw messages; equal arguments give equal bytes.

    epoch_ns: time of t_s = 0; the time of receipt of a sample is that of its measurement. speed_unit: unit to display
    speeds in; samples are in rad/s. tachos: how they are measured. progress: is given the time of the newest sample, s.
    An existing recording is replaced.

    Raises:
        RecordingError: it cannot be written.
    """
    played = PlaybackCounts(start_ns=epoch_ns)

    def raws() -> Iterator[Raw]:
        for block in _blocks(device, played):
            yield _raw(device.fans, block, epoch_ns)
            played.samples_sent += len(block)
            progress(block[-1].t_s)

    write_raw(
        path,
        raws(),
        epoch_ns,
        PRODUCER,
        source="simulated tray",
        site=SITE,
        tray=TRAY,
        speed_unit=speed_unit,
        tachos=tachos,
    )
    return played


def write_raw(
    path: Path,
    raws: Iterable[Raw],
    first_t_ns: int,
    producer: str,
    *,
    source: str,
    site: str,
    tray: str,
    speed_unit: str,
    tachos: Sequence[Tacho],
    names: FanNames = NO_NAMES,
) -> None:
    """Write the samples of a tray to a recording. They get their headers here; a message is received with its last
    sample. An existing recording is replaced.

    Raises:
        RecordingError: it cannot be written.
    """
    metadata = {"source": source, "site": site, "trays": tray, "speed_unit": speed_unit}
    if tuple(tachos) != INSTANTANEOUS:
        metadata[f"{TACHO_KEY}.{tray}"] = tachos_to_json(tachos)
    if any(names.names):
        metadata[f"{NAMES_KEY}.{tray}"] = names.as_json()
    with RecordingWriter(path, metadata, t_ns=first_t_ns, overwrite=True) as writer:
        for sequence, raw in enumerate(raws):
            numbered = replace(raw, header=Header(producer, sequence, tray))
            writer.add_message(tray_key(site, tray, "raw"), numbered, int(raw.host_receive_t_ns[-1]))


def write_table(
    table: Table, output: Path, tray: str, tachos: tuple[Tacho, ...] = INSTANTANEOUS, names: FanNames = NO_NAMES
) -> None:
    """Write the samples of a table as raw messages; the time of receipt is the time in the table.

    Raises:
        RecordingError: it cannot be written.
    """
    auxiliary: dict[str, Any] = dict(table.auxiliary)
    whole = Raw(
        fans=table.fans,
        host_receive_t_ns=table.t_ns,
        command=table.command,
        speed_rad_s=table.speed_rad_s,
        **auxiliary,
    )
    # The first message has one sample only, so that the recording begins at the time of its first sample.
    starts = [0, *range(1, len(table.t_ns), SAMPLES_PER_MESSAGE), len(table.t_ns)]
    raws = (cut(whole, first, end) for first, end in pairwise(starts))
    about = {"source": table.path.name, "site": IMPORTED, "tray": tray, "speed_unit": table.speed_unit}
    write_raw(output, raws, int(table.t_ns[0]), "import", **about, tachos=tachos, names=names)


def _blocks(device: Device, played: PlaybackCounts) -> Iterator[list[DeviceSample]]:
    """The samples that are not lost, in blocks of `SAMPLES_PER_MESSAGE`; the last one may be shorter."""
    block: list[DeviceSample] = []
    while device.due_s() is not None:
        sample = device.take()
        if sample.lost:
            played.samples_dropped += 1
            continue
        block.append(sample)
        if len(block) == SAMPLES_PER_MESSAGE:
            yield block
            block = []
    if block:
        yield block


def _raw(fans: int, block: list[DeviceSample], epoch_ns: int) -> Raw:
    auxiliary: dict[str, Any] = {
        name: np.stack([sample.auxiliary[name] for sample in block]).astype(np.float32) for name in block[0].auxiliary
    }
    return Raw(
        fans=fans,
        host_receive_t_ns=np.array([epoch_ns + round(sample.t_s * NS_PER_S) for sample in block], np.int64),
        device_clock_us=np.array([sample.clock_us for sample in block], np.uint32),
        device_sequence=np.array([sample.sequence for sample in block], np.uint32),
        command=np.stack([sample.command for sample in block]),
        speed_rad_s=np.stack([sample.speed_rad_s for sample in block]),
        **auxiliary,
    )
