"""Makes messages of raw samples from readings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.sources.source import Reading
from fantwin.pipeline.timebase.device_clock import UINT32
from fantwin.schemas.auxiliary import AUXILIARY
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
            bool(reading.supply_voltage_v),
            bool(reading.current_a),
            bool(reading.temperature_c),
        )


def raw_message(block: Sequence[ReceivedReading], tray: TrayConfig, tachos: tuple[StatedTacho, ...] = ()) -> Raw:
    """Make one message of samples that agree in their columns. tachos: what their source states to measure."""
    readings = [received.reading for received in block]
    auxiliary: dict[str, Any] = {
        column.name: _float32([getattr(r, column.name) for r in readings]) for column in AUXILIARY
    }
    return Raw(
        fans=tray.fans,
        host_receive_t_ns=np.array([received.t_ns for received in block], np.int64),
        device_clock_us=_uint32(r.clock_us for r in readings),
        device_sequence=_uint32(r.sequence for r in readings),
        command=np.array([r.command for r in readings], np.float64),
        speed_rad_s=np.array([r.speed for r in readings], np.float64) * RAD_S_PER_UNIT[tray.speed_unit],
        tachos=tachos,
        **auxiliary,
    )


def _uint32(values: Iterable[int | None]) -> Array:
    """A column of numbers that wrap at 2^32; empty if the samples have none."""
    return np.array([value % UINT32 for value in values if value is not None], np.uint32)


def _float32(rows: list[tuple[float, ...]]) -> Array:
    """A column, (samples, fans); empty if the samples have none."""
    return np.array(rows if rows[0] else (), np.float32)
