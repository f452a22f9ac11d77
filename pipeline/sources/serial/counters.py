"""Counters of a device, such as that of damaged frames: how far they advanced while the host read its line."""

from __future__ import annotations

from collections.abc import Mapping

from fantwin.schemas.wire import DEVICE_COUNTERS, UINT16, UINT32, DeviceCounters

_WRAPS_FROM_S = UINT32 // 100 - 60
"""an uptime that a device derives from the 32-bit number of its samples, at most 100 a second, wraps a minute later at
the earliest: some frames before the wrap may be lost"""


class DeviceCounterSteps:
    """Follows the counters of one device, which wrap, and start again at 0 when it restarts.

    A device has restarted if its uptime is smaller than before, and is not one that may have wrapped; or if a counter
    went back: by less than half its range, since a step forward of more than that within a second or two is no count.
    A restart that shows neither, because all counters have passed their earlier values since, counts too little. The
    host's clock is no evidence: after it was busy, what the device has sent meanwhile arrives late and at once.
    """

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
        was_interrupted, self._was_interrupted = self._was_interrupted, False
        if last is not None and _has_restarted(last, now, was_interrupted=was_interrupted):
            before = (0,) * len(now.counts)
        elif last is None or was_interrupted or len(last.counts) != len(now.counts):
            before = now.counts
        else:
            before = last.counts
        return dict(zip(DEVICE_COUNTERS, _advance(before, now.counts), strict=False))


def _has_restarted(last: DeviceCounters, now: DeviceCounters, *, was_interrupted: bool) -> bool:
    went_back = any(step > UINT16 // 2 for step in _advance(last.counts, now.counts))
    if now.uptime_s < last.uptime_s:
        return went_back or last.uptime_s < _WRAPS_FROM_S
    return went_back and not was_interrupted  # in a long interruption a counter may advance by any number


def _advance(before: tuple[int, ...], now: tuple[int, ...]) -> list[int]:
    return [(count - earlier) % UINT16 for count, earlier in zip(now, before, strict=False)]
