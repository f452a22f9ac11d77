"""Recordings for tests of replays: raw samples of a tray whose fans follow their commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Raw
from fantwin.schemas.topics import tray_key

START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000


def raw_of(sample: int, fans: int, *, sequence: int | None = None, tray: str = "tray1", samples: int = 1) -> Raw:
    """`samples` samples from number `sample` on; a device with a clock, 2 ms away from the host."""
    numbers = np.arange(sample, sample + samples)
    command = 0.5 + 0.3 * np.sin(numbers[:, np.newaxis] / 200 + np.arange(fans))
    return Raw(
        header=Header("acquisition-1", sample if sequence is None else sequence, tray),
        fans=fans,
        host_receive_t_ns=START_NS + numbers * STEP_NS,
        device_clock_us=(numbers * STEP_NS // 1000).astype(np.uint32),
        device_sequence=numbers.astype(np.uint32),
        command=command,
        speed_rad_s=900 * command,
    )


def write_raw(path: Path, samples: int, *, fans: int = 8, tray: str = "tray1", missing: range = range(0)) -> Path:
    """A recording of one sample a message, received 2 ms later, without those that are `missing`."""
    kept = [sample for sample in range(samples) if sample not in missing]
    with RecordingWriter(path, {"trays": tray, "speed_unit": "rpm"}, t_ns=START_NS) as writer:
        for sequence, sample in enumerate(kept):
            raw = raw_of(sample, fans, sequence=sequence, tray=tray)
            writer.add_message(tray_key("demo", tray, "raw"), raw, START_NS + sample * STEP_NS + 2_000_000)
    return path
