"""What a device has counted itself, such as damaged frames: how much since the host reads its line."""

from __future__ import annotations

from collections.abc import Mapping

from schemas.wire import DEVICE_COUNTERS, UINT16, DeviceCounters


class DeviceCounterSteps:
    """Follows the counters of one device, which wrap, and start again at 0 when it restarts."""

    def __init__(self) -> None:
        self._last: DeviceCounters | None = None
        self._was_interrupted = True

    def connection_interrupted(self) -> None:
        """What the device counts until its next frame was not on this connection, unless it restarts."""
        self._was_interrupted = True

    def steps(self, now: DeviceCounters) -> Mapping[str, int]:
        """How much was counted since the frame before, by the names of `DEVICE_COUNTERS`; after an interruption 0, or
        what was counted since the restart of the device."""
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
