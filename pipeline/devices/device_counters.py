"""How far the counters of a device, such as that of damaged frames, have advanced while the host read its line."""

from __future__ import annotations

from collections.abc import Mapping

from schemas.wire import DEVICE_COUNTERS, UINT16, DeviceCounters


class DeviceCounterSteps:
    """Follows the counters of one device, which wrap, and start again at 0 when it restarts."""

    def __init__(self) -> None:
        self._last: DeviceCounters | None = None
        self._was_interrupted = True

    def connection_interrupted(self) -> None:
        """Leave out what the device counts until its next frame, unless the device restarts meanwhile."""
        self._was_interrupted = True

    def steps(self, now: DeviceCounters) -> Mapping[str, int]:
        """The advance of each counter since the frame before, by the names of `DEVICE_COUNTERS`. If the device has
        restarted: since the restart. Otherwise 0 for the first frame after an interruption."""
        last, self._last = self._last, now
        if last is not None and now.uptime_s <= last.uptime_s:
            before = (0,) * len(now.counts)
        elif last is None or self._was_interrupted or len(last.counts) != len(now.counts):
            before = now.counts
        else:
            before = last.counts
        self._was_interrupted = False
        steps = [(count - earlier) % UINT16 for count, earlier in zip(now.counts, before, strict=True)]
        return dict(zip(DEVICE_COUNTERS, steps, strict=False))
