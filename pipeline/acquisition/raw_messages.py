"""Makes messages of raw samples from readings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.sources.source import Reading
from fantwin.pipeline.timebase.device_clock import UINT32
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.messages import Array, Raw, StatedTacho
from fantwin.schemas.units import RAD_S_PER_UNIT


@dataclass(frozen=True, slots=True)
class ReceivedReading:
    """A reading that will be published, and its time of receipt."""

    reading: Reading
    t_ns: int

    @property
    def columns(self) -> tuple[bool, ...]:
        """Presence of each optional column: the samples of one message must agree."""
        reading = self.reading
        return (
            reading.clock_us is not None,
            reading.sequence is not None,
            *(each.name in reading.measured for each in CHANNELS),
        )


def raw_message(block: Sequence[ReceivedReading], tray: TrayConfig, tachos: tuple[StatedTacho, ...] = ()) -> Raw:
    """Make one message of samples that agree in their columns. tachos: what their source states to measure."""
    readings = [received.reading for received in block]
    measured: dict[str, Any] = {
        name: np.array([reading.measured[name] for reading in readings], np.float32) for name in readings[0].measured
    }
    return Raw(
        fans=tray.fans,
        host_receive_t_ns=np.array([received.t_ns for received in block], np.int64),
        device_clock_us=_uint32(r.clock_us for r in readings),
        device_sequence=_uint32(r.sequence for r in readings),
        command=np.array([r.command for r in readings], np.float64),
        speed_rad_s=np.array([r.speed for r in readings], np.float64) * RAD_S_PER_UNIT[tray.speed_unit],
        tachos=tachos,
        **measured,
    )


def _uint32(values: Iterable[int | None]) -> Array:
    """A column of numbers that wrap at 2^32; empty if the samples have none."""
    return np.array([value % UINT32 for value in values if value is not None], np.uint32)
