"""The device's 32-bit sequence number: which samples were lost, repeated, or follow a restart of the device.

Samples that were refused are lost. The gap that they leave in the sequence shows it; until there is a gap, or where
there is no sequence, they are counted as `lost_refused`.
"""

from __future__ import annotations

from collections import Counter, deque

from fantwin.pipeline.sources.source import Reading
from fantwin.pipeline.timebase.device_clock import LARGEST_GAP, UINT32

_RECENT_SAMPLES = 64  # how far back a repeated sample is recognised


class DeviceSequence:
    """Follows the sequence numbers of one device."""

    def __init__(self) -> None:
        self.refused = 0
        """samples refused since the last that was used"""
        self._last: int | None = None
        self._recent: deque[tuple[int, int | None]] = deque(maxlen=_RECENT_SAMPLES)

    def connection_interrupted(self) -> None:
        """The device may have been restarted: a number seen before may now belong to a new sample."""
        self._recent.clear()

    def is_new(self, reading: Reading, counts: Counter[str]) -> bool:
        """Return whether the reading is new; counts `lost_on_line`, `lost_refused`, `repeated` and
        `device_restarts`."""
        is_shown = False
        if reading.sequence is not None and self._last is not None:
            step = (reading.sequence - self._last) % UINT32
            is_shown = 1 <= step <= LARGEST_GAP
            if step != 1:
                if (reading.sequence, reading.clock_us) in self._recent:
                    counts["repeated"] += 1
                    return False
                if 1 < step <= LARGEST_GAP:
                    counts["lost_on_line"] += step - 1
                else:
                    counts["device_restarts"] += 1
        if self.refused and not is_shown:
            counts["lost_refused"] += self.refused
        self.refused = 0
        if reading.sequence is not None:
            self._last = reading.sequence
            self._recent.append((reading.sequence, reading.clock_us))
        return True
