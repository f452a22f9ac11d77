"""The device's 32-bit sequence number: which samples were lost, repeated, or follow a restart of the device."""

from __future__ import annotations

from collections import Counter, deque

from pipeline.devices.device_clock import UINT32
from pipeline.devices.sample_source import Reading

LARGEST_GAP = 1 << 24
"""Samples; 46 h at 100 Hz. A larger step of the sequence is a restart of the device."""
_RECENT_SAMPLES = 64  # how far back a repeated sample is recognised


class DeviceSequence:
    """Follows the sequence numbers of one device."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._recent: deque[tuple[int, int | None]] = deque(maxlen=_RECENT_SAMPLES)

    def connection_interrupted(self) -> None:
        """The device may have been restarted: a number seen before may now belong to a new sample."""
        self._recent.clear()

    def is_new(self, reading: Reading, counts: Counter[str]) -> bool:
        """Whether the reading is new; counts `lost_on_line`, `repeated` and `device_restarts`."""
        if reading.sequence is None:
            return True
        if self._last is not None:
            step = (reading.sequence - self._last) % UINT32
            if step != 1:
                if (reading.sequence, reading.clock_us) in self._recent:
                    counts["repeated"] += 1
                    return False
                if 1 < step <= LARGEST_GAP:
                    counts["lost_on_line"] += step - 1
                else:
                    counts["device_restarts"] += 1
        self._last = reading.sequence
        self._recent.append((reading.sequence, reading.clock_us))
        return True
