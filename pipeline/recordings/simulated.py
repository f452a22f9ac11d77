"""A simulated device's samples straight into a recording, as fast as they come: material to train twins on."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from pipeline.devices.simulated_device import Device, DeviceSample, Played
from pipeline.recordings.writing import RecordingWriter
from schemas.messages import Header, Raw
from schemas.topics import tray_key

SITE, TRAY, PRODUCER = "simulated", "tray1", "simulate"
_SAMPLES_A_MESSAGE = 100


def record(device: Device, path: Path, epoch_ns: int, duration_s: float, speed_unit: str) -> Played:
    """Write all samples of a device as Raw messages; the file depends on nothing but the arguments.

    epoch_ns: time of the device's t_s = 0; a sample counts as received when it was measured. duration_s: for the
    progress shown on stderr. speed_unit: that people are to be shown; samples are in rad/s. A finished recording of
    that name is replaced.

    Raises:
        RecordingError: it cannot be written.
    """
    played = Played(start_ns=epoch_ns)
    metadata = {
        "made_by": f"fantwin {version('fantwin')}",
        "source": "simulated tray",
        "site": SITE,
        "trays": TRAY,
        "speed_unit": speed_unit,
    }
    with (
        RecordingWriter(path, metadata, t_ns=epoch_ns, overwrite=True) as writer,
        Progress(console=Console(stderr=True), transient=True) as progress,
    ):
        task = progress.add_task(f"simulating {duration_s:g} s", total=duration_s)
        for sequence, block in enumerate(_blocks(device, played)):
            raw = _raw(device.fans, block, epoch_ns, sequence)
            writer.add_message(tray_key(SITE, TRAY, "raw"), raw, int(raw.host_receive_t_ns[-1]))
            played.samples_sent += len(block)
            progress.update(task, completed=block[-1].t_s)
    return played


def _blocks(device: Device, played: Played) -> Iterator[list[DeviceSample]]:
    """The samples that are not lost, in blocks of `_SAMPLES_A_MESSAGE`; the last may be shorter."""
    block: list[DeviceSample] = []
    while device.due_s() is not None:
        sample = device.take()
        if sample.lost:
            played.samples_dropped += 1
            continue
        block.append(sample)
        if len(block) == _SAMPLES_A_MESSAGE:
            yield block
            block = []
    if block:
        yield block


def _raw(fans: int, block: list[DeviceSample], epoch_ns: int, sequence: int) -> Raw:
    return Raw(
        header=Header(PRODUCER, sequence, TRAY),
        fans=fans,
        host_receive_t_ns=np.array([epoch_ns + round(sample.t_s * 1e9) for sample in block], np.int64),
        device_clock_us=np.array([sample.clock_us for sample in block], np.uint32),
        device_sequence=np.array([sample.sequence for sample in block], np.uint32),
        command=np.stack([sample.command for sample in block]),
        speed_rad_s=np.stack([sample.speed_rad_s for sample in block]),
    )
