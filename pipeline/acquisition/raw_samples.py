"""The samples of trays as their acquisition publishes them, for commands that look at a running site."""

from __future__ import annotations

import queue
from collections.abc import Iterable
from contextlib import suppress

from fantwin.pipeline.bus.session import Bus
from fantwin.schemas.codec import CodecError, decode
from fantwin.schemas.messages import Raw
from fantwin.schemas.topics import tray_key


class RawSamples:
    """What has arrived and was not taken yet."""

    def __init__(self, bus: Bus, site: str, trays: Iterable[str]) -> None:
        self._received: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        for tray in trays:
            bus.subscribe(tray_key(site, tray, "raw"), lambda _key, payload: self._received.put(payload))

    def take(self, timeout_s: float = 0.0) -> list[Raw]:
        """All samples since the last call; waits for one if there is none. What cannot be decoded is left out."""
        found: list[Raw] = []
        with suppress(queue.Empty):
            while True:
                payload = self._received.get(timeout=0.0 if found else timeout_s)
                with suppress(CodecError):
                    found.append(decode(Raw, payload))
        return [sample for sample in found if len(sample.host_receive_t_ns)]
