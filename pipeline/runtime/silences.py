"""Whether nothing comes because nothing is sent, or because the link to the producer may be cut.

A stage that works publishes health each second, with the number of messages that it has published. So a consumer that
has as many knows that there was no more until then. Without that, a silence says nothing: what was sent may be kept by
its producer, and come when the link is there again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from schemas.messages import Health, StageStatus
from schemas.streams import StreamId, output_streams


class Silences:
    """Of the main inputs of a stage."""

    def __init__(self, trays: Mapping[str, str]) -> None:
        """trays: that of each key of the main input."""
        self._trays = trays
        self._reporting: set[str] = set()
        """trays whose producer publishes health, and has not ended in order with all that it sent"""
        self._ended: dict[str, Callable[[], bool]] = {}
        """of trays whose producer has ended in order: whether all that it sent has arrived"""
        self._shown: set[str] = set()

    def add_health(self, health: Health, has_all_of: Callable[[StreamId, int], bool]) -> None:
        """A stage says how many messages it has published; has_all_of: whether a stream has arrived up to a number."""
        for stream, published in output_streams(health).items():
            tray = self._trays.get(stream[0])
            if tray is None:
                continue
            has_all = partial(has_all_of, stream, published)
            if has_all():
                self._shown.add(tray)
            self._reporting.add(tray)
            if health.status == StageStatus.STOPPED:
                self._ended[tray] = has_all
            else:
                self._ended.pop(tray, None)

    def take(self, tray: str) -> bool:
        """Whether its producer has shown, since this was last asked, that there is no more; True also for a producer
        that never shows it."""
        if tray in self._ended and self._ended[tray]():
            self._reporting.discard(tray)
            del self._ended[tray]
        if tray not in self._reporting:
            return True
        is_shown = tray in self._shown
        self._shown.discard(tray)
        return is_shown
